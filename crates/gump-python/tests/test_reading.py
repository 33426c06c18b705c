"""Scenarios from files and messages: what they hold, memory, and what is refused."""

import pickle
import resource
import struct

import numpy as np
import pytest

import gump
from conftest import MINI, content, shared


def records(path):
    """The messages of a TFRecord file."""
    data, at, found = content(path), 0, []
    while at < len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        found.append(data[at + 12 : at + 12 + length])
        at += length + 16
    return found


def test_a_scenario_is_arrays(crossing):
    tracks = crossing.tracks
    n, steps = len(tracks.agent_id), len(crossing)
    assert (crossing.dt, crossing.now, steps) == (0.1, 10, 91)
    assert tracks.agent_id.dtype == np.int64 and (np.diff(tracks.agent_id) > 0).all()
    shapes = [tracks.valid, tracks.position, tracks.heading, tracks.velocity, tracks.size]
    assert [one.shape for one in shapes] == [(n, steps), (n, steps, 3), (n, steps), (n, steps, 2), (n, steps, 3)]
    assert len(tracks.kind) == n and set(tracks.kind) <= {"vehicle", "pedestrian", "bicycle", "other"}
    assert (np.isnan(tracks.position).any(axis=2) == ~tracks.valid).all()
    assert (tracks.size[tracks.valid] > 0).all()
    there = tracks.agent_id[tracks.valid[:, crossing.now]]
    assert np.array_equal(crossing.simulated, there)
    assert crossing.ego in there and set(crossing.targets) <= set(tracks.agent_id)
    rows = np.searchsorted(tracks.agent_id, there)
    assert np.array_equal(crossing.future[..., :3], tracks.position[rows, crossing.now + 1 :], equal_nan=True)
    assert crossing.id in repr(crossing)


def test_velocities_are_those_of_the_positions(crossing):
    tracks = crossing.tracks
    both = tracks.valid[:, 1:] & tracks.valid[:, :-1]
    moved = np.diff(tracks.position[..., :2], axis=1) / crossing.dt
    apart = np.linalg.norm(moved - tracks.velocity[:, 1:], axis=2)[both]
    assert np.median(apart) < 0.2


def test_a_map_is_lines(crossing):
    road = crossing.map
    assert road.lanes and road.road_edges and road.drivable
    ids = {lane.id for lane in road.lanes}
    for lane in road.lanes:
        assert lane.centerline.ndim == 2 and lane.centerline.shape[1] == 3 and len(lane.centerline) >= 2
        assert set(lane.successors) <= ids and lane.width > 0
    assert set(crossing.route.tolist()) <= ids
    assert any(area.kind == "crosswalk" for area in road.areas)


def test_lights_have_colours():
    lights, crossing = next(
        (one.lights, one)
        for one in gump.open(MINI / "procedural.tfrecord.gz")
        if {1, 3} <= set(one.lights.state.ravel().tolist())
    )
    assert len(lights.lane_id) > 0
    assert lights.state.shape == (len(lights.lane_id), len(crossing))
    assert lights.stop_point.shape == (*lights.state.shape, 2)
    names = gump.types.LIGHT_STATES
    assert names[1] == "green" and names[3] == "red"


def test_messages_are_what_files_hold(scenes):
    messages = records(MINI / "procedural.tfrecord.gz")[:3]
    for message, scenario in zip(messages, scenes):
        read = gump.read(message)
        assert read.id == scenario.id
        assert np.array_equal(read.tracks.position, scenario.tracks.position, equal_nan=True)
        assert gump.read(memoryview(message)).id == scenario.id


def test_scenarios_have_names():
    path = MINI / "procedural.tfrecord.gz"
    first = gump.find(str(path))
    third = gump.find(f"{path}#2")
    assert gump.find(f"{path}#{third.id}").id == third.id != first.id
    states = np.repeat(np.nan_to_num(third.future)[None], 2, axis=0)
    (same,) = [one for one in gump.open(path) if one.id == third.id]
    found = gump.wosac.score(third, third.simulated, states)
    assert found == gump.wosac.score(same, same.simulated, states)


def test_a_saved_scenario_is_read_again(crossing, tmp_path):
    crossing.save(tmp_path / "one.tfrecord")
    (again,) = gump.open(tmp_path)
    assert again.id == crossing.id
    assert np.allclose(again.tracks.position, crossing.tracks.position, equal_nan=True, atol=1e-4)


@pytest.mark.parametrize("name", ["argoverse2", "commonroad_ngsim", "gpudrive", "taf_bw", "waymo"])
def test_every_format_opens(name):
    scenario = next(gump.open(shared(f"data/{name}")))
    assert len(scenario) > 1 and len(scenario.simulated) > 0
    assert scenario.tracks.valid.any()


def test_a_folder_of_everything_is_read(tmp_path):
    seen = sum(1 for _ in gump.open(MINI))
    each = sum(1 for path in sorted(MINI.rglob("*.tfrecord.gz")) for _ in gump.open(path))
    assert seen == each > 20


def test_memory_does_not_grow_with_scenarios(tmp_path):
    """The peak stays where it was after the first pass."""
    data = content(MINI / "procedural.tfrecord.gz")
    big = tmp_path / "many.tfrecord"
    with open(big, "wb") as file:
        for _ in range(6):
            file.write(data)
    reader = gump.open(big)
    n = len(records(MINI / "procedural.tfrecord.gz"))
    for _ in range(n):
        next(reader)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert sum(1 for _ in reader) == 5 * n
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 40 << 10, f"{grown} KiB"


def test_a_closed_reader_says_so():
    with gump.open(MINI / "procedural.tfrecord.gz") as reader:
        next(reader)
    with pytest.raises(ValueError, match="expected a reader that is open, found one that was closed"):
        next(reader)


def test_what_is_not_there_or_not_scenarios(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a file or directory, found none"):
        gump.open(tmp_path / "nowhere.tfrecord")
    (tmp_path / "empty.tfrecord").write_bytes(b"")
    with pytest.raises(gump.DataError, match="empty file"):
        gump.open(tmp_path / "empty.tfrecord")
    (tmp_path / "noise.tfrecord").write_bytes(bytes(range(256)) * 4)
    with pytest.raises(gump.DataError, match="noise.tfrecord"):
        next(gump.open(tmp_path / "noise.tfrecord"))
    with pytest.raises(gump.DataError, match="expected a waymo.open_dataset.Scenario message"):
        gump.read(b"\xff\xff\xff")
    with pytest.raises(gump.DataError, match="expected"):
        gump.read(b"")
    with pytest.raises(TypeError, match="message: expected bytes, found int"):
        gump.read(5)
    with pytest.raises(gump.DataError, match="no such|expected"):
        gump.find(f"{MINI / 'procedural.tfrecord.gz'}#9999")
    with pytest.raises(TypeError):
        gump.open(5)


def test_a_damaged_record_is_told_and_passed(tmp_path):
    data = bytearray(content(MINI / "procedural.tfrecord.gz"))
    (length,) = struct.unpack_from("<Q", data, 0)
    data[12 + length // 2] ^= 0xFF
    path = tmp_path / "damaged.tfrecord"
    path.write_bytes(data)
    reader, found, told = gump.open(path), 0, []
    while True:
        try:
            next(reader)
            found += 1
        except StopIteration:
            break
        except gump.DataError as error:
            told.append(str(error))
    assert len(told) == 1 and "checksum" in told[0] and "record 0" in told[0]
    assert found == len(records(MINI / "procedural.tfrecord.gz")) - 1


def test_a_scenario_is_no_pickle(crossing):
    with pytest.raises(TypeError):
        pickle.dumps(crossing)
