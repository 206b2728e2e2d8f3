"""A recorded or live source through the whole program: the same path for both."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..drivers.ouster import Source, open_source
from .config import Config
from .pipeline import Counts
from .program import Program

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
    with open_source(source, meta, wish=config.sensor.wish) as frames:
        recorded = frames.n_frames_estimate is not None  # a live sensor waits for nobody
        with Program(data, config, source, wait=recorded and rate is None) as program:
            pipeline, worker, detection = program.pipeline, program.worker, program.detection
            try:
                for frame in _paced(frames, rate):
                    pipeline.process(frame)
                    progress(pipeline.counts, detection.n_changes, frames.n_frames_estimate)
            except KeyboardInterrupt:
                logger.info("interrupted: closing the session")
            pipeline.finish()
            worker.drain()
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
