"""What the service says of itself: true, fresh, and readable by people, programs and Prometheus."""

import json
import re
import time
from dataclasses import asdict, replace

import pytest
from click.testing import CliRunner

from revisitd.daemon.board import _line
from revisitd.daemon.cli import cli
from revisitd.daemon.metrics import metrics_text
from revisitd.daemon.status import (
    DetectionStatus,
    FrameStatus,
    NotRunning,
    PlaceStatus,
    SensorStatus,
    Status,
    StoreStatus,
    read_status,
    status_path,
    status_table,
    write_status,
)

SENSOR = SensorStatus("os-1.local", "running", "", 0, 1, "122", "OS-1-64", "v3.1", "RNG15", "1024x10", "INTERNAL")
FRAMES = FrameStatus(10.0, 100, 2, 0, 0.001, {"columns missing": 16, 'odd "cause"': 1})
PLACE = PlaceStatus("good", 1, 3, 1, (4, 5), 20, (1,))
DETECTION = DetectionStatus(0.0, 0, 7, 0, 0, 2, 9)
SIZES = 5_000_000_000, 50_000_000_000, 41_000_000_000  # used, quota, free
STORE = StoreStatus("/data", *SIZES, 1200, 0, "", ("index.db was lost",), 200 << 20, 300 << 20)


@pytest.fixture
def status(tmp_path):
    store = replace(STORE, data=str(tmp_path))
    line = _line(SENSOR, FRAMES, PLACE, DETECTION, STORE)
    now = time.time_ns()
    about = (*line, "0.1.0", 4711, now - 90_000_000_000, now, "abc", "def")
    return Status(*about, SENSOR, FRAMES, PLACE, DETECTION, store)


def test_a_status_is_read_as_it_was_written(tmp_path, status):
    write_status(status_path(tmp_path), status)
    assert read_status(tmp_path) == json.loads(json.dumps(asdict(status)))


def test_an_old_status_is_not_believed(tmp_path, status):
    write_status(status_path(tmp_path), replace(status, updated_host_ns=status.updated_host_ns - 3_600_000_000_000))
    with pytest.raises(NotRunning, match="last written 1 h ago"):
        read_status(tmp_path)


def test_no_status_is_exit_code_3(tmp_path):
    result = CliRunner().invoke(cli, ["status", "--data", str(tmp_path)])
    assert result.exit_code == 3 and "does not run" in result.output


def test_people_see_each_subject_on_a_line(tmp_path, status):
    table = status_table(asdict(status))
    assert "state      running: good 10.0 Hz, loss 0.1%, scene 4, 5, 9 changes, 41 GB free" in table
    assert "repaired   index.db was lost" in table
    assert "up 1 min 30 s" in table and "16 x columns missing" in table


def test_a_status_of_another_version_is_named(status):
    old = asdict(status)
    del old["store"]["repairs"]
    with pytest.raises(NotRunning, match="another version"):
        status_table(old)


@pytest.mark.parametrize(
    "changed,state,says",
    [
        ({"sensor": replace(SENSOR, phase="silent", problem="check the cable")}, "waiting", "silent: check the cable"),
        ({"sensor": replace(SENSOR, problem="packets fail their checksum")}, "degraded", "packets fail"),
        ({"frames": replace(FRAMES, hz=5.0)}, "degraded", "only 5.0 of 10 Hz"),
        ({"frames": replace(FRAMES, received=0)}, "waiting", "no usable frame yet"),
        ({"place": replace(PLACE, odometry="too few returns")}, "lost", "odometry lost (too few returns)"),
        ({"store": replace(STORE, problem="no space left")}, "degraded", "no space left"),
    ],
)
def test_the_line_says_what_is_wrong(changed, state, says):
    parts = {"sensor": SENSOR, "frames": FRAMES, "place": PLACE, "detection": DETECTION, "store": STORE} | changed
    word, line = _line(**parts)
    assert word == state and says in line


def test_prometheus_can_read_every_line(status):
    about, sample = r"# (HELP|TYPE) revisitd_\w+ .+", r'revisitd_\w+(\{(\w+="([^"\\]|\\.)*",?)*\})? [0-9.e+-]+'
    for line in metrics_text(status).splitlines():
        assert re.fullmatch(f"{about}|{sample}", line), line
    assert 'revisitd_losses_total{cause="odd \\"cause\\""} 1' in metrics_text(status)
