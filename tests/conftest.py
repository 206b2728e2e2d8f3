"""Shared fixtures."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real captures, where a developer has them; they may not be redistributed with the project."""
    if not SHARED.is_dir():
        pytest.skip(f"real captures are not at {SHARED}")
    return SHARED


@pytest.fixture(scope="session")
def tiny_patrol(tmp_path_factory):
    """There and back again past a crate that is taken away and a person who comes; people walk about."""
    virtual = pytest.importorskip("revisitd.drivers.virtual", reason="the virtual sensor needs the extra [sim]")
    return virtual.simulate(
        tmp_path_factory.mktemp("patrol"), scenario="tiny", seed=0, beams=64, profile="RNG15_RFL8_NIR8"
    )
