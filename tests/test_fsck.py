"""revisitd fsck: what it finds, what it mends, and that it deletes nothing."""

import sqlite3

import pytest
from click.testing import CliRunner
from stored import SESSION, add_visit, make_change, make_scan

from revisitd.daemon.cli import cli
from revisitd.storage.backup import back_up_if_due
from revisitd.storage.fsck import check, repair
from revisitd.storage.store import Store


@pytest.fixture
def data(tmp_path):
    with Store.open_writer(tmp_path / "data") as store:
        session = store.index.start_session(**SESSION)
        add_visit(store, 1, 1, session, 5)
        add_visit(store, 1, 2, session, 5)
        store.changes.add(make_change())
        store.dir.put_sensor(SESSION["sensor_digest"], "{}")
        back_up_if_due(store.dir, 0.0, kept=3)
    return tmp_path / "data"


def run(*arguments):
    result = CliRunner().invoke(cli, ["fsck", *(str(argument) for argument in arguments)])
    return result.exit_code, result.output


def path_of(data, scan_id):
    return data / "scans" / "1" / "0" / f"{scan_id}.scan"


def spoil(path):
    path.write_bytes(path.read_bytes()[:-1] + b"?")


def index(data, sql):
    with sqlite3.connect(data / "index.db") as connection:
        connection.execute(sql)
    connection.close()


EMPTY = (".db-wal", ".db-shm")  # come with every connection


def everything(data):
    return {path: path.read_bytes() for path in data.rglob("*") if path.is_file() and path.suffix not in EMPTY}


def test_a_whole_directory_is_clean(data):
    code, text = run(data)
    assert code == 0
    assert text == f"{data}: 1 sessions, 10 scans, 1 scenes, 2 visits, 10 scan files: clean\n"


def test_a_directory_in_use_is_clean_and_may_be_checked_but_not_repaired(data):
    with Store.open_writer(data) as store:
        store.add_scan(make_scan(store.new_scan_id()))
        assert run(data)[0] == 0
        path_of(data, 3).unlink()
        code, text = run(data, "--repair")
        assert code == 74
        assert "writes here" in text


HARMS = {
    "a file is missing": (
        lambda data: path_of(data, 3).unlink(),
        "scan 3 of session 1: in the index, but there is no file: taken out of the index",
    ),
    "a file is not known": (
        lambda data: index(data, "DELETE FROM scans WHERE scan_id = 3"),
        "scan 3 of session 1: a whole file that the index does not know: entered",
    ),
    "a known file is damaged": (
        lambda data: spoil(path_of(data, 3)),
        "3.scan: damaged: its checksum does not match",
    ),
    "an unknown file is damaged": (
        lambda data: (index(data, "DELETE FROM scans WHERE scan_id = 3"), spoil(path_of(data, 3))),
        "moved to damaged/, and out of the index",
    ),
    "a deletion was cut off": (
        lambda data: index(data, "INSERT INTO garbage (scan_id, session_id) VALUES (99, 1)"),
        "scan 99 of session 1: its deletion was cut off: finished",
    ),
    "the index is damaged": (
        lambda data: (data / "index.db").write_bytes((data / "index.db").read_bytes()[:20_000] + bytes(40_000)),
        "index.db: ",
    ),
    "changes.db is damaged": (
        lambda data: (data / "changes.db").write_bytes(b"no database, but a text" * 100),
        "changes.db: not a database",
    ),
    "the index is gone": (lambda data: (data / "index.db").unlink(), "index.db: no such file"),
    "a row of the index refers to nothing": (
        lambda data: index(data, "DELETE FROM visits WHERE number = 2"),
        "visit_scans refers to a row that is not in visits",
    ),
    "a backup is damaged": (
        lambda data: next((data / "backups").iterdir()).write_bytes(b"no database, but a text" * 100),
        "not a database",
    ),
}


@pytest.mark.parametrize("harm,says", HARMS.values(), ids=HARMS)
def test_what_is_wrong_is_named_and_mended_on_demand_alone(data, harm, says):
    harm(data)
    before = everything(data)
    code, text = run(data)
    assert code == 1
    assert says in text
    assert everything(data) == before
    lost = sum(name.stat().st_size for name in data.rglob("*.scan"))
    code, text = run(data, "--repair")
    assert code == 0, text
    assert sum(name.stat().st_size for name in data.rglob("*.scan")) == lost
    assert run(data)[0] == 0
    with Store.open_reader(data) as store:
        assert len(store.changes.changes()) == 1


def test_missing_metadata_of_a_sensor_cannot_be_mended(data):
    next((data / "sensors").iterdir()).unlink()
    code, text = run(data, "--repair")
    assert code == 1
    assert "still wrong: sensors/0123456789abcdef.json: missing" in text


def test_what_is_no_data_directory_is_an_error_of_its_own(tmp_path):
    code, text = run(tmp_path)
    assert code == 74
    assert "not a revisitd data directory" in text


def test_visits_of_an_entered_scan_are_not_known_but_the_scan_is(data):
    index(data, "DELETE FROM scans WHERE scan_id = 3")
    assert check(data).unknown == [(1, 3)]
    repair(data)
    with Store.open_reader(data) as store:
        assert 3 in store.index.trajectory().scan_id
