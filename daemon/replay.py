"""A recorded or live source through the whole program: the same path for both."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from ..drivers.ouster import Source, open_source
from ..models.descriptor import DescriptorModel
from ..storage.store import Store
from .config import Config, dump_config
from .detection_process import DetectionProcess
from .housekeeping import Housekeeping
from .instances import ChangeDetection
from .pipeline import Counts, Pipeline
from .sensors import Sensors
from .worker import DetectionWorker

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Summary:
    """What one run did."""

    counts: Counts
    losses: dict[str, int]  # packets, columns and frames lost, by cause
    instances_done: int
    instances_failed: int
    instances_dropped: int
    changes: int
    seconds: float


Progress = Callable[[Counts, int, int | None], None]  # counts, changes, frames expected; called for each frame


def replay(
    source: str, data: Path, meta: Path | None, config: Config, rate: float | None, progress: Progress
) -> Summary:
    """Run a source to its end. rate None: as fast as it goes, nothing is dropped; else a multiple of real time.

    Raises DriverError for a source that cannot be read or that held no usable frame, and the storage's errors.
    """
    start = time.perf_counter()
    with open_source(source, meta) as frames, Store.open_writer(data) as store:
        (data / "config.toml").write_text(dump_config(config), encoding="utf-8")
        model = DescriptorModel.load()
        process = DetectionProcess(store.dir.path)
        detection = ChangeDetection(config, store, process, model.model_id)
        worker = DetectionWorker(detection.run, config.worker.queue_size)
        housekeeping = Housekeeping(store, config)
        joining = ThreadPoolExecutor(1, thread_name_prefix="joining")
        try:
            recorded = frames.n_frames_estimate is not None  # a live sensor waits for nobody
            pipeline = Pipeline(
                config,
                store,
                Sensors(store.dir),
                model,
                worker,
                lambda question: joining.submit(process.locate, question),
                source,
                wait=recorded and rate is None,
            )
            try:
                for frame in _paced(frames, rate):
                    pipeline.process(frame)
                    progress(pipeline.counts, detection.n_changes, frames.n_frames_estimate)
            except KeyboardInterrupt:
                logger.info("interrupted: closing the session")
            pipeline.finish()
            worker.drain()
        finally:
            worker.close()
            housekeeping.close()
            joining.shutdown(cancel_futures=True)
            process.close()
        progress(pipeline.counts, detection.n_changes, frames.n_frames_estimate)
        pipeline.gate.require_accepted(source)
        return Summary(
            pipeline.counts,
            {str(cause): count for cause, count in {**frames.losses, **pipeline.gate.losses}.items() if count},
            worker.done,
            worker.failed,
            worker.dropped,
            detection.n_changes,
            time.perf_counter() - start,
        )


def _paced(frames: Source, rate: float | None):
    """Frames at a multiple of the speed at which the sensor made them."""
    first: tuple[float, int] | None = None
    for frame in frames:
        if rate is not None and frame.column_valid.any():
            first = first or (time.monotonic(), frame.stamp_ns)
            due = first[0] + (frame.stamp_ns - first[1]) * 1e-9 / rate
            time.sleep(max(0.0, due - time.monotonic()))
        yield frame
