"""What a run of revisitd consists of beside its source: the store, the model, the pipeline, the detection."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from ..models.descriptor import DescriptorModel
from ..storage.errors import StorageUnavailable
from ..storage.store import Store
from .config import Config, dump_config
from .detection_process import DetectionProcess
from .housekeeping import Housekeeping
from .instances import ChangeDetection
from .pipeline import Pipeline
from .sensors import Sensors
from .worker import DetectionWorker

logger = logging.getLogger(__name__)


class Program:
    """Opens everything in order; a context manager that closes it in the reverse one, when what is queued is done.

    data: the data directory, made if it is not there. source: what the sessions name as their source. wait: for the
    detection when it lags (a recorded source); a live one drops instances instead, and counts them.
    Raises the storage's errors, OSError and ModelError.
    """

    def __init__(self, data: Path, config: Config, source: str, wait: bool):
        with ExitStack() as opened:
            self.store = opened.enter_context(Store.open_writer(data))
            try:
                self.store.dir.put_settings(dump_config(config))
            except StorageUnavailable as why:  # a robot drives on without it, and the retention may free the disk
                logger.warning("this run's settings are not kept: %s", why)
            self.model = DescriptorModel.load()
            self.process = DetectionProcess(self.store.dir.path, config.worker.timeout_s)
            opened.callback(self.process.close)
            joining = ThreadPoolExecutor(1, thread_name_prefix="joining")
            opened.callback(joining.shutdown, cancel_futures=True)
            self.housekeeping = opened.enter_context(Housekeeping(self.store, config))
            self.detection = ChangeDetection(config, self.store, self.process, self.model)
            # Visits whose instance was still due when the last run ended, killed perhaps.
            self.worker = DetectionWorker(self.detection.run, config.worker.queue_size, self.detection.due())
            opened.callback(self.worker.close)
            self.pipeline = Pipeline(
                config,
                self.store,
                Sensors(self.store.dir),
                self.model,
                self.worker,
                lambda question: joining.submit(self.process.locate, question),
                source,
                wait,
            )
            self._opened = opened.pop_all()

    def stop(self, within_s: float) -> None:
        """End the session; let the instance at hand finish if it does so in time, and leave the others for the next
        run: the index knows them."""
        self.pipeline.finish()
        self.detection.hurry.set()
        self.worker.stop(within_s)
        self.process.kill()  # with the instance that took too long, or the question where the robot is

    def __enter__(self) -> Program:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._opened.close()
