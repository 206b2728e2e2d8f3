"""The detection thread and its process: bounded, counted, and not brought down by one bad instance."""

import os
import signal
import threading

import numpy as np
import pytest

from revisitd.daemon.comparison import Job, Selection
from revisitd.daemon.config import Config
from revisitd.daemon.detection.results import Thresholds
from revisitd.daemon.detection_process import DetectionProcess, JobFailed, Stopped
from revisitd.daemon.worker import DetectionWorker, Instance
from revisitd.storage.store import Store


def instance(scene):
    return Instance(1, 1, scene, scene, 2, 0, 1)


def test_a_live_robot_drops_the_newest_instance_of_a_full_queue_and_counts_it():
    begun, go, ran = threading.Event(), threading.Event(), []

    def run(job):
        begun.set()
        go.wait()
        ran.append(job.scene_id)

    worker = DetectionWorker(run, queue_size=2)
    assert worker.submit(instance(1), wait=False)
    begun.wait()
    assert [worker.submit(instance(scene), wait=False) for scene in (2, 3, 4)] == [True, True, False]
    go.set()
    worker.close()
    assert ran == [1, 2, 3]
    assert (worker.done, worker.dropped) == (3, 1)


def test_a_replay_waits_for_the_queue_and_drops_nothing():
    ran = []
    worker = DetectionWorker(lambda job: ran.append(job.scene_id), queue_size=1)
    assert all(worker.submit(instance(scene), wait=True) for scene in range(20))
    worker.drain()
    assert ran == list(range(20)) and worker.dropped == 0
    worker.close()


def test_an_instance_that_fails_does_not_end_the_detection_of_others(caplog):
    def run(job):
        if job.scene_id == 1:
            raise ValueError("bad scene")

    worker = DetectionWorker(run, queue_size=4)
    worker.submit(instance(1), wait=True)
    worker.submit(instance(2), wait=True)
    worker.close()
    assert (worker.done, worker.failed) == (1, 1)
    assert "instance failed scene=1" in caplog.text


def test_instances_of_earlier_runs_are_done_when_the_queue_is_empty():
    begun, go, ran = threading.Event(), threading.Event(), []

    def run(job):
        begun.set()
        go.wait()
        ran.append(job.scene_id)

    worker = DetectionWorker(run, queue_size=2, backlog=[instance(7), instance(8)])
    begun.wait()
    worker.submit(instance(1), wait=False)
    assert worker.n_waiting == 2
    go.set()
    worker.drain()
    assert ran == [7, 1, 8]
    worker.close()


def test_a_stop_begins_no_further_instance_and_says_whether_the_one_at_hand_is_done():
    begun, go, ran = threading.Event(), threading.Event(), []

    def run(job):
        begun.set()
        go.wait()
        ran.append(job.scene_id)

    worker = DetectionWorker(run, queue_size=4)
    for scene in (1, 2, 3):
        worker.submit(instance(scene), wait=True)
    begun.wait()
    assert worker.busy_s > 0
    assert not worker.stop(within_s=0.05)
    go.set()
    assert worker.stop(within_s=60.0)
    worker.close()
    assert ran == [1] and worker.busy_s == 0


@pytest.fixture
def process(tmp_path):
    with Store.open_writer(tmp_path / "data"):
        started = DetectionProcess(tmp_path / "data", timeout_s=60.0)
        yield started
        started.close()


def job():
    scans = Selection(*np.array([[1], [7], [1], [0]]), np.zeros((1, 3)), np.array([True]))
    return Job(scans, scans, [], [], 25.0, Thresholds(**Config().detection.model_dump()))


def test_a_scan_that_is_gone_fails_a_comparison_that_has_too_few_others(process):
    with pytest.raises(JobFailed, match="ScanFileError: 0 of 1 scans can be read"):
        process.compare(job())


def test_a_killed_detection_process_fails_one_comparison_and_is_replaced(process):
    os.kill(process._process.pid, signal.SIGKILL)
    with pytest.raises(JobFailed, match="died .exit code -9."):
        process.compare(job())
    with pytest.raises(JobFailed, match="ScanFileError"):
        process.compare(job())


def test_a_job_that_does_not_end_fails_and_the_next_one_has_a_new_process(tmp_path):
    with Store.open_writer(tmp_path / "data"):
        process = DetectionProcess(tmp_path / "data", timeout_s=0.01)  # its imports take longer
        first = process.pid
        with pytest.raises(JobFailed, match="not done after 0.01 s"):
            process.compare(job())
        assert process.pid != first
        process.close()


def test_a_killed_program_part_says_nothing_against_the_job(process):
    process.kill()
    with pytest.raises(Stopped):
        process.compare(job())
