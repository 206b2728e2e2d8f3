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
