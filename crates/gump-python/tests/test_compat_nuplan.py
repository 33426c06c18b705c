"""nuplan-devkit's planners in our loop and its histories under our scores; what needs the devkit skips without it."""

from types import SimpleNamespace

import numpy as np
import pytest

import gump
from conftest import MINI
from gump.compat.nuplan import MetricsEngine, Planner

THEIRS = SimpleNamespace(token="t", log_name="log", scenario_name="name", scenario_type="kind")


@pytest.fixture(scope="module")
def road():
    return gump.find(str(MINI / "procedural.tfrecord.gz"))


def sample(scenario, drive, step):
    """A step of a drive with the attributes of the devkit's samples."""
    x, y, heading, vx, vy, ax, ay, steering, steering_rate, yaw_rate, yaw_acceleration = drive.ego[step]
    motion = SimpleNamespace(
        rear_axle_velocity_2d=SimpleNamespace(x=vx, y=vy),
        rear_axle_acceleration_2d=SimpleNamespace(x=ax, y=ay),
        tire_steering_rate=steering_rate,
        angular_velocity=yaw_rate,
        angular_acceleration=yaw_acceleration,
    )
    ego = SimpleNamespace(
        time_us=drive.time_us[step],
        rear_axle=SimpleNamespace(x=x, y=y, heading=heading),
        dynamic_car_state=motion,
        tire_steering_angle=steering,
    )
    objects = []
    for agent, state in zip(drive.agent_id, drive.others[:, step]):
        if agent != scenario.ego and np.isfinite(state).all():
            center = SimpleNamespace(x=state[0], y=state[1], heading=state[3])
            velocity = SimpleNamespace(x=state[4], y=state[5])
            objects.append(SimpleNamespace(track_token=str(agent), center=center, velocity=velocity))
    return SimpleNamespace(ego_state=ego, observation=SimpleNamespace(tracked_objects=objects))


@pytest.mark.parametrize("world", ["log", "idm"])
def test_histories_score_as_they_were_driven(road, world):
    drive = gump.nuplan.simulate(road, "idm", world, seconds=3.0)
    history = SimpleNamespace(data=[sample(road, drive, step) for step in range(len(drive.time_us))])
    engine = MetricsEngine({"t": road})
    assert engine.score(history, THEIRS).metrics == drive.metrics
    assert engine.score(history, THEIRS).score == drive.score
    by_function = MetricsEngine(lambda scenario: road, agent_of=int)
    assert by_function.score(history, THEIRS).metrics == drive.metrics
    nobody = MetricsEngine({"t": road}, agent_of=lambda token: None)
    assert set(nobody.score(history, THEIRS).metrics) == set(drive.metrics)
    (told,) = engine.compute(history, THEIRS, "me").items()
    assert told[0] == "kind_name_me" and len(told[1]) == len(drive.metrics)
    with pytest.raises(KeyError, match="t"):
        MetricsEngine({}).score(history, THEIRS)


def test_a_planner_of_the_devkit_drives_as_ours(road):
    reason = "nuplan-devkit is not installed"
    simple = pytest.importorskip("nuplan.planning.simulation.planner.simple_planner", reason=reason)
    planner = simple.SimplePlanner(horizon_seconds=10.0, sampling_time=0.25, acceleration=[0.0, 0.0])
    drive = gump.nuplan.simulate(road, Planner(planner), "idm", seconds=3.0)
    ours = gump.nuplan.simulate(road, "simple", "idm", seconds=3.0)
    assert np.allclose(drive.ego, ours.ego, atol=1e-9) and drive.metrics == ours.metrics


def test_without_the_devkit(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "nuplan", None)
    for name in [name for name in sys.modules if name.startswith("nuplan.")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(ImportError, match="nuplan"):
        Planner(object())
