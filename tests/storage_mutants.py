"""Damaged files of the storage, the same for the same seed, and what comes of reading them.

An outcome is a word or two: what was read as it had been written, what was put right, or the storage's own error. Any
other exception is a fault of the program.
"""

from __future__ import annotations

import json
import logging
import random
import shutil
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from stored import SESSION, add_visit, make_change, make_scan

from revisitd.daemon.config import Config, ConfigError, dump_config, load_config
from revisitd.storage import scanfile
from revisitd.storage.errors import StorageError
from revisitd.storage.fsck import check
from revisitd.storage.scans import Scan
from revisitd.storage.store import Store

ODD = [None, True, -1, 0, 2**31, 2**63, 2**200, 1e308, "", "x" * 100, [], {}, [[]], [1] * 16, "nan", -(2**63)]
ODD_TEXT = ["nan", "-1", "1e999", "[]", "'x'", "true", "0x10", "99999999999999999999", "''", "{}"]


def outcome_of(what: str, seed: int) -> str:
    """What comes of one mutant."""
    logging.disable()  # each damaged file is an error to the log
    return MUTANTS[what](random.Random(f"{what} {seed}"))


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Some bytes changed, cut, doubled, zeroed or made noise of."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 5, 50])):
        at = rng.randrange(len(data) + 1) if data else 0
        length = min(rng.choice([1, 1, 4, 100, 4096]), len(data) - at)
        match rng.randrange(6):
            case 0:
                data[at : at + 1] = bytes([rng.randrange(256)])
            case 1:
                del data[at : at + length]
            case 2:
                data[at:at] = data[at : at + length]
            case 3:
                data[at : at + length] = bytes(length)
            case 4:
                data[at : at + length] = rng.randbytes(length)
            case 5:
                del data[at:]
    return bytes(data)


def _odd_json(value: object, rng: random.Random) -> object:
    """The value with something in it replaced, dropped or added."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if rng.random() < 0.2:
            return {name: kept for name, kept in value.items() if name != key}
        if rng.random() < 0.1:
            return {**value, "odd": rng.choice(ODD)}
        return {**value, key: _odd_json(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.7:
        i = rng.randrange(len(value))
        return [*value[:i], _odd_json(value[i], rng), *value[i + 1 :]]
    return rng.choice(ODD)


# Scan files ---------------------------------------------------------------------------------------------------------


@cache
def _scan() -> tuple[Scan, bytes]:
    scan = make_scan(7, shape=(16, 128))
    return scan, scanfile.encode(scan)


def scan_file(rng: random.Random) -> str:
    """Bytes of a scan file; in half of the mutants the checksum holds, as if a bad program had written it."""
    scan, data = _scan()
    prefix = scanfile.PREFIX
    head_end = prefix.size + prefix.unpack_from(data)[2]
    whole = rng.random() < 0.5
    if whole and rng.random() < 0.6:
        head = json.dumps(_odd_json(json.loads(data[prefix.size : head_end]), rng)).encode()
        body = data[head_end:]
    elif whole:
        head, body = data[prefix.size : head_end], mutated(data[head_end:], rng)
    else:
        return _outcome_of_scan(mutated(data, rng), scan)
    checksum = zlib.crc32(body, zlib.crc32(head))
    packed = prefix.pack(scanfile.MAGIC, scanfile.VERSION, len(head), len(body), checksum)
    return _outcome_of_scan(packed + head + body, None)


def _outcome_of_scan(data: bytes, original: Scan | None) -> str:
    try:
        scan = Scan(**scanfile.decode(data, Path("7.scan")))
    except StorageError as error:
        assert "\n" not in str(error)
        return type(error).__name__
    assert scan.range_mm.shape == scan.reflectivity.shape
    assert scan.column_ns.shape == scan.column_valid.shape == scan.range_mm.shape[1:]
    if original is not None:
        assert all(np.array_equal(value, getattr(original, name)) for name, value in vars(scan).items())
    return "read"


# Databases and their kin --------------------------------------------------------------------------------------------


@cache
def _data_dir() -> Path:
    """A directory that is copied for each mutant."""
    data = Path(tempfile.mkdtemp(prefix="mutants-")) / "data"
    with Store.open_writer(data) as store:
        session = store.index.start_session(**SESSION)
        for number in (1, 2):
            add_visit(store, 1, number, session, 4)
        for i in range(5):
            store.changes.add(make_change(at=(3.0 * i, 0.0, 0.0), n_points=300))
        store.changes.merge(5, 4)
    return data


def _file(name: str) -> Callable[[random.Random], str]:
    def mutant(rng: random.Random) -> str:
        return _outcome_of_dir(name, mutated((_data_dir() / name).read_bytes(), rng))

    return mutant


def places(rng: random.Random) -> str:
    """places.jsonl of a lost index; in half of the mutants the checksums hold."""
    data = (_data_dir() / "places.jsonl").read_bytes()
    if rng.random() < 0.5:
        return _outcome_of_dir("places.jsonl", mutated(data, rng), lost="index.db")
    texts = [json.dumps(_odd_json(json.loads(line[9:]), rng)).encode() for line in data.splitlines()]
    return _outcome_of_dir(
        "places.jsonl", b"".join(b"%08x %s\n" % (zlib.crc32(text), text) for text in texts), lost="index.db"
    )


def identity(rng: random.Random) -> str:
    """revisitd.json."""
    data = (_data_dir() / "revisitd.json").read_bytes()
    text = mutated(data, rng) if rng.random() < 0.5 else json.dumps(_odd_json(json.loads(data), rng)).encode()
    return _outcome_of_dir("revisitd.json", text)


def _outcome_of_dir(name: str, content: bytes, lost: str | None = None) -> str:
    """Everything that reads a data directory in which one file is another."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        shutil.copytree(_data_dir(), data)
        (data / name).write_bytes(content)
        if lost:
            (data / lost).unlink()
        tasks = [_use] if lost else [_read, check, _use]
        return ", ".join(_attempt(task, data) for task in tasks)


def _attempt(task: Callable[[Path], object], data: Path) -> str:
    try:
        outcome = task(data)
    except StorageError as error:
        assert "\n" not in str(error)
        return type(error).__name__
    return outcome if isinstance(outcome, str) else "checked"


def _read(data: Path) -> str:
    """As another program does."""
    with Store.open_reader(data) as store:
        _read_all(store)
    return "read"


def _use(data: Path) -> str:
    """As the daemon does: open, read, write."""
    with Store.open_writer(data) as store:
        _read_all(store)
        store.add_scan(make_scan(store.new_scan_id()))
        store.changes.add(make_change())
        return "repaired" if store.repairs else "used"


def _read_all(store: Store) -> None:
    store.index.trajectory()
    store.index.all_descriptors("feedc0ffee00")
    for scene in store.index.scenes():
        store.index.scans_of_scene(scene.scene_id)
        store.index.visits(scene.scene_id)
    store.index.counts()
    for change in store.changes.changes():
        store.changes.history(change.id)
    store.changes.since(0)


# Settings -----------------------------------------------------------------------------------------------------------


def settings(rng: random.Random) -> str:
    """A settings file: bytes mutated, or one value replaced by an odd one."""
    lines = dump_config(Config()).splitlines()
    if rng.random() < 0.5:
        i = rng.choice([i for i, line in enumerate(lines) if " = " in line and not line.startswith("#")])
        lines[i] = f"{lines[i].split(' = ')[0]} = {rng.choice(ODD_TEXT)}"
        text = "\n".join(lines).encode()
    else:
        text = mutated("\n".join(lines).encode(), rng)
    with tempfile.NamedTemporaryFile(suffix=".toml") as file:
        file.write(text)
        file.flush()
        try:
            load_config(Path(file.name))
        except ConfigError as error:
            assert all(line.startswith(file.name) for line in str(error).splitlines())
            return "ConfigError"
    return "read"


MUTANTS: dict[str, Callable[[random.Random], str]] = {
    "scan": scan_file,
    "index": _file("index.db"),
    "changes": _file("changes.db"),
    "places": places,
    "identity": identity,
    "settings": settings,
}
