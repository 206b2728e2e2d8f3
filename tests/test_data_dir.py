"""Who may open a data directory, and what is in it after a kill at the worst moments."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from stored import SESSION, make_scan

from revisitd.storage.datadir import DataDir
from revisitd.storage.errors import DatabaseFileError, DataDirBusy, DataDirError, NewerFormat
from revisitd.storage.store import Store


def test_a_data_directory_is_made_where_there_is_none_and_keeps_its_identity(tmp_path):
    with Store.open_writer(tmp_path / "deep" / "data") as store:
        identity = store.dir.uuid
    with Store.open_writer(tmp_path / "deep" / "data") as store:
        assert store.dir.uuid == identity


def test_a_second_writer_is_told_who_holds_the_directory(tmp_path):
    with Store.open_writer(tmp_path / "data"):
        with pytest.raises(DataDirBusy, match=f"process {os.getpid()} writes here"):
            Store.open_writer(tmp_path / "data")
    Store.open_writer(tmp_path / "data").close()


def test_readers_open_beside_a_writer(tmp_path):
    with Store.open_writer(tmp_path / "data"), Store.open_reader(tmp_path / "data") as reader:
        assert reader.index.counts()["scans"] == 0


def test_a_reader_does_not_make_a_directory(tmp_path):
    with pytest.raises(DataDirError, match="not a revisitd data directory"):
        Store.open_reader(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_a_directory_with_other_things_in_it_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(DataDirError, match="holiday.jpg"):
        Store.open_writer(tmp_path)


def test_a_directory_of_a_newer_version_is_refused_by_both(tmp_path):
    Store.open_writer(tmp_path).close()
    identity = json.loads((tmp_path / "revisitd.json").read_text())
    (tmp_path / "revisitd.json").write_text(json.dumps({**identity, "version": 99}))
    for opening in (Store.open_writer, Store.open_reader):
        with pytest.raises(NewerFormat, match="format 99.*upgrade"):
            opening(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "revisitd data directory"}'])
def test_a_damaged_identity_is_named(tmp_path, text):
    Store.open_writer(tmp_path).close()
    (tmp_path / "revisitd.json").write_text(text)
    with pytest.raises(DataDirError, match=r"revisitd\.json: damaged"):
        Store.open_writer(tmp_path)


@pytest.mark.parametrize("name", ["index.db", "changes.db"])
def test_a_database_of_a_newer_version_is_refused_by_both(tmp_path, name):
    Store.open_writer(tmp_path).close()
    connection = sqlite3.connect(tmp_path / name)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    for opening in (Store.open_writer, Store.open_reader):
        with pytest.raises(NewerFormat, match=f"{name}: schema 99.*upgrade"):
            opening(tmp_path)


@pytest.mark.parametrize("name", ["index.db", "changes.db"])
def test_a_database_of_another_directory_is_noticed(tmp_path, name):
    for directory in ("mine", "other"):
        Store.open_writer(tmp_path / directory).close()
    (tmp_path / "other" / name).replace(tmp_path / "mine" / name)
    with pytest.raises(DataDirError, match=f"{name}: belongs to data directory"):
        Store.open_writer(tmp_path / "mine")


@pytest.mark.parametrize("name", ["index.db", "changes.db"])
def test_a_file_that_is_no_database_is_named_to_readers(tmp_path, name):
    Store.open_writer(tmp_path).close()
    (tmp_path / name).write_bytes(b"this is not a database, it is a text of some length" * 100)
    with pytest.raises(DatabaseFileError, match=f"{name}: not a database"):
        Store.open_reader(tmp_path)


def test_a_failed_opening_lets_the_next_writer_in(tmp_path):
    Store.open_writer(tmp_path).close()
    whole = (tmp_path / "revisitd.json").read_text()
    (tmp_path / "revisitd.json").write_text("{")
    with pytest.raises(DataDirError):
        Store.open_writer(tmp_path)
    (tmp_path / "revisitd.json").write_text(whole)
    Store.open_writer(tmp_path).close()


@pytest.mark.parametrize("kind", ["nfs4", "cifs", "fuse.sshfs"])
def test_a_network_file_system_is_refused(tmp_path, monkeypatch, kind):
    table = tmp_path / "mountinfo"
    table.write_text(
        f"1 0 8:1 / / rw,relatime - ext4 /dev/sda1 rw\n2 1 0:40 / {tmp_path}/my\\040share rw - {kind} server:/ rw\n"
    )
    monkeypatch.setattr("revisitd.storage.filesystem.MOUNTS", table)
    with pytest.raises(DataDirError, match=f"network file system .{kind}.*use a local disk"):
        Store.open_writer(tmp_path / "my share" / "data")
    Store.open_writer(tmp_path / "data").close()


def test_the_metadata_of_a_sensor_is_kept_as_it_was_given(tmp_path):
    text = '{"sensor_info": {"prod_line": "OS-1-128", "note": "\u00b5"}}\n'
    directory = DataDir.open_writer(tmp_path)
    directory.put_sensor("0123456789abcdef", text)
    directory.put_sensor("0123456789abcdef", "{}")
    directory.close()
    assert DataDir.open_reader(tmp_path).get_sensor("0123456789abcdef") == text


def test_missing_metadata_of_a_sensor_is_named(tmp_path):
    with Store.open_writer(tmp_path) as store, pytest.raises(DataDirError, match=r"feed\.json: missing"):
        store.dir.get_sensor("feed")


# Kills --------------------------------------------------------------------------------------------------------------

WRITER = """
import os, signal, sys
sys.path.insert(0, sys.argv[3])
from stored import SESSION, make_scan
from revisitd.storage.store import Store

def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)

with Store.open_writer(sys.argv[1]) as store:
    session = store.index.start_session(**SESSION)
    store.index.add_scene(1, session, [[0, 0]], 2.5, 20.0)
    visit = store.index.open_visit(1, 1, session, 0)
    for _ in range(3):
        scan = make_scan(store.new_scan_id(), session)
        store.add_scan(scan, [visit])
        print(scan.scan_id, flush=True)
    match sys.argv[2]:
        case "before the file is renamed":
            os.replace = die
        case "between file and row":
            store.index.add_scan = die
        case "within the transaction":
            store.index.add_visit_scans = die
        case "while the file is written":
            os.fsync = die
    store.add_scan(make_scan(store.new_scan_id(), session), [visit])
"""


@pytest.mark.parametrize(
    "moment",
    [
        "while the file is written",
        "before the file is renamed",
        "between file and row",
        "within the transaction",
    ],
)
def test_after_a_kill_all_that_was_acknowledged_is_there_and_nothing_is_half_there(tmp_path, moment):
    command = [sys.executable, "-c", WRITER, str(tmp_path / "data"), moment, str(Path(__file__).parent)]
    killed = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    acknowledged = [int(line) for line in killed.stdout.split()]
    assert acknowledged == [1, 2, 3]
    with Store.open_reader(tmp_path / "data") as reader:
        assert reader.index.scans_of_scene(1).scan_id.tolist() == acknowledged
        assert reader.index.trajectory().scan_id.tolist() == acknowledged
    with Store.open_writer(tmp_path / "data") as store:
        on_disk = list(store.scans.iter_ids())
        for session, scan_id in on_disk:
            store.scans.read(session, scan_id)
        assert on_disk[:3] == [(1, 1), (1, 2), (1, 3)]
        assert store.new_scan_id() > on_disk[-1][1]
        assert list((tmp_path / "data" / "scans" / "tmp").iterdir()) == []


def test_scan_ids_go_on_after_a_restart_and_deleted_ids_are_not_used_again(tmp_path):
    with Store.open_writer(tmp_path) as store:
        session = store.index.start_session(**SESSION)
        ids = [store.new_scan_id() for _ in range(3)]
        for scan_id in ids:
            store.add_scan(make_scan(scan_id, session))
    store.scans.delete(list(store.scans.iter_ids()))
    with Store.open_writer(tmp_path) as store:
        assert store.new_scan_id() > max(ids)
