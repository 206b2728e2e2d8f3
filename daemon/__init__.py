"""The program: the life of a frame, change detection, the service and its commands."""

import os

# Before numpy is loaded: its matrix products are small here, and OpenBLAS's second thread spins between them. It took
# 30 s of CPU where one thread takes 9 (90 key scans, relocate.py's steps, both cores busy), and halved the frame rate.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
