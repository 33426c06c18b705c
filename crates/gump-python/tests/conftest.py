"""Data for the tests: what the repository ships, and `../shared` beside it where it is."""

import gzip
import json
import os
from pathlib import Path

import pytest

import gump

REPOSITORY = Path(__file__).resolve().parents[3]
MINI = REPOSITORY / "datasets" / "mini"
GOLDEN = REPOSITORY / "crates" / "gump-wosac" / "tests" / "golden" / "realism"


def shared(name):
    """A file or folder under `../shared`: a skip where it is absent, a failure with REQUIRE_SHARED=1."""
    path = REPOSITORY.parent / "shared" / name
    if path.exists():
        return path
    assert os.environ.get("REQUIRE_SHARED") != "1", f"REQUIRE_SHARED=1, but ../shared/{name} is not there"
    pytest.skip(f"../shared/{name} is not beside the repository")


def content(path):
    """The bytes of a file, unpacked if it is gzip."""
    data = Path(path).read_bytes()
    return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data


def document(path):
    """A JSON file, unpacked if it is gzip."""
    return json.loads(content(path))


@pytest.fixture(scope="session")
def crossing():
    """A crossing with traffic lights that the shipped weights did not learn from."""
    return gump.find(f"{MINI / 'procedural.tfrecord.gz'}#20")


@pytest.fixture(scope="session")
def scenes():
    """The first three shipped scenes."""
    reader = gump.open(MINI / "procedural.tfrecord.gz")
    return [next(reader) for _ in range(3)]


@pytest.fixture(scope="session")
def network():
    """The world of the shipped weights."""
    return gump.World("model")
