"""The program: the life of a frame, change detection, the service and its commands."""

import os

# Before numpy is loaded: its matrix products are small here, and OpenBLAS's second thread waits busily between them. On
# a machine whose cores are busy that costs more than all the work (OPENBLAS_NUM_THREADS=2 relocate.py shows it).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
