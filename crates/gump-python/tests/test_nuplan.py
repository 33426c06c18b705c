"""nuPlan's loop and scores: our planners, planners in Python, and what is refused."""

import numpy as np
import pytest

import gump
from conftest import MINI
from gump.nuplan import EGO_FIELDS, EgoState


@pytest.fixture(scope="module")
def road():
    """A scene with a route that can be driven through."""
    return gump.find(str(MINI / "procedural.tfrecord.gz"))


class Cruise:
    """Goes straight on at the speed it has."""

    def __init__(self):
        self.mission = None
        self.inputs = []

    def name(self):
        return "cruise"

    def initialize(self, initialization):
        self.mission = initialization

    def compute_planner_trajectory(self, current_input):
        self.inputs.append(current_input)
        ego = current_input.ego
        steps = 0.1 * np.arange(1, 41)
        ahead = ego.velocity_x * steps
        return np.column_stack(
            [ego.x + ahead * np.cos(ego.heading), ego.y + ahead * np.sin(ego.heading), np.full(40, ego.heading)]
        )


def test_our_planners_drive(road):
    for planner in ("idm", "simple", "pdm-closed", "log"):
        drive = gump.nuplan.simulate(road, planner, "log", seconds=3.0)
        assert 0.0 <= drive.score <= 1.0
        assert drive.ego.shape == (len(drive.time_us), len(EGO_FIELDS))
        assert drive.others.shape == (len(drive.agent_id), len(drive.time_us), 6)
        assert "no_ego_at_fault_collisions" in drive.metrics
    pdm = gump.nuplan.simulate(road, gump.planners.PdmClosed(), "idm", seconds=3.0)
    assert pdm.metrics == gump.nuplan.simulate(road, "pdm-closed", "idm", seconds=3.0).metrics


def test_a_planner_in_python_drives(road):
    cruise = Cruise()
    drive = gump.nuplan.simulate(road, cruise, "log", seconds=3.0, controller="perfect")
    n = len(drive.time_us)
    assert len(cruise.inputs) == n
    assert cruise.mission.scenario.id == road.id
    assert cruise.mission.vehicle.wheel_base > 1.0
    first, last = cruise.inputs[0], cruise.inputs[-1]
    assert [one.iteration.index for one in cruise.inputs] == list(range(n))
    assert len(first.history.ego_states) == min(road.now + 1, 22) == len(first.history.observations)
    assert len(last.history.ego_states) == 22
    assert (np.diff([ego.time_us for ego in last.history.ego_states]) > 0).all()
    assert road.ego not in first.observation.agent_id
    assert len(first.observation.agent_id) == len(road.simulated) - 1
    driven = np.array([list(one.ego)[1:] for one in cruise.inputs])
    assert np.allclose(driven, drive.ego)
    # Straight on at one speed.
    assert np.allclose(drive.ego[:, 2], drive.ego[0, 2])
    moved = np.linalg.norm(np.diff(drive.ego[:, :2], axis=0), axis=1)
    assert np.allclose(moved, 0.1 * drive.ego[0, 3], atol=1e-3)


def test_every_kind_of_trajectory_is_the_same(road):
    class Timed(Cruise):
        def compute_planner_trajectory(self, current_input):
            poses = super().compute_planner_trajectory(current_input)
            return np.column_stack([0.1 * np.arange(1, 41), poses])

    class Stated(Cruise):
        def compute_planner_trajectory(self, current_input):
            poses, ego = super().compute_planner_trajectory(current_input), current_input.ego
            later = [EgoState(ego.time_us + 100_000 * (i + 1), *pose, *ego[4:]) for i, pose in enumerate(poses)]
            return [ego, *later]

    drives = [gump.nuplan.simulate(road, kind(), "log", seconds=3.0) for kind in (Cruise, Timed, Stated)]
    for drive in drives[1:]:
        assert np.allclose(drive.ego[:, :3], drives[0].ego[:, :3], atol=1e-3)


def test_what_was_driven_scores_the_same_elsewhere(road):
    for world in ("log", "idm"):
        drive = gump.nuplan.simulate(road, "pdm-closed", world, seconds=3.0)
        score = gump.nuplan.score(road, drive.time_us, drive.ego, drive.agent_id, drive.others)
        assert score.metrics == drive.metrics and score.score == drive.score
    # Positions alone come near: the rest is taken from differences.
    near = gump.nuplan.score(road, drive.time_us, drive.ego[:, :3])
    assert near.metrics["ego_progress_along_expert_route"] == drive.metrics["ego_progress_along_expert_route"]


def test_a_plan_of_ours(road):
    plan = gump.planners.PdmClosed().plan(road)
    assert plan.shape[1] == 1 + len(EGO_FIELDS)
    assert plan[0, 0] <= 0.0 < plan[-1, 0] and (np.diff(plan[:, 0]) > 0).all()


def test_imagining_planners_take_a_world(road):
    planner = gump.planners.Imitation(gump.World("constant-velocity"))
    drive = gump.nuplan.simulate(road, planner, "log", seconds=1.0)
    assert 0.0 <= drive.score <= 1.0


def test_a_planner_that_raises(road):
    class Fails(Cruise):
        def compute_planner_trajectory(self, current_input):
            if current_input.iteration.index == 3:
                raise KeyError("lost the way")
            return super().compute_planner_trajectory(current_input)

    with pytest.raises(gump.nuplan.PlannerError, match="cruise raised KeyError: 'lost the way' at step 3") as told:
        gump.nuplan.simulate(road, Fails(), "log", seconds=3.0)
    assert isinstance(told.value.__cause__, KeyError)

    class FailsAtOnce(Cruise):
        def initialize(self, initialization):
            raise ValueError("no mission")

    with pytest.raises(gump.nuplan.PlannerError, match="cruise raised ValueError: no mission in initialize"):
        gump.nuplan.simulate(road, FailsAtOnce(), "log", seconds=3.0)

    class Interrupted(Cruise):
        def compute_planner_trajectory(self, current_input):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gump.nuplan.simulate(road, Interrupted(), "log", seconds=3.0)


@pytest.mark.parametrize(
    "plan, sentence",
    [
        (np.zeros((5, 2)), r"expected a trajectory of shape \[N, 3\] or \[N, 4\], found \[5, 2\]"),
        (np.full((5, 3), np.nan), "expected a trajectory of numbers"),
        (np.zeros((0, 3)), "expected a trajectory of at least 1 state, found none"),
        (None, "expected real numbers"),
        ("straight on", "expected real numbers"),
    ],
)
def test_trajectories_that_are_none(road, plan, sentence):
    class Plans(Cruise):
        def compute_planner_trajectory(self, current_input):
            return plan

    with pytest.raises(gump.nuplan.PlannerError, match=sentence):
        gump.nuplan.simulate(road, Plans(), "log", seconds=3.0)


def test_times_that_do_not_increase(road):
    class Plans(Cruise):
        def compute_planner_trajectory(self, current_input):
            return np.zeros((3, 4))

    with pytest.raises(ValueError, match="the planner's trajectory: "):
        gump.nuplan.simulate(road, Plans(), "log", seconds=3.0)


def test_what_is_refused(road):
    with pytest.raises(TypeError, match="found object without initialize"):
        gump.nuplan.simulate(road, object(), "log")
    with pytest.raises(ValueError, match="planner: expected log, idm, .*, found nobody"):
        gump.nuplan.simulate(road, "nobody", "log")
    with pytest.raises(ValueError, match="controller: expected two-stage or perfect, found none"):
        gump.nuplan.simulate(road, "idm", "log", controller="none")
    with pytest.raises(ValueError):
        gump.nuplan.simulate(road, "idm", "log", seconds=-1.0)
    drive = gump.nuplan.simulate(road, "idm", "log", seconds=2.0)
    with pytest.raises(ValueError, match=r"ego: expected an array of shape \[N, 11\]"):
        gump.nuplan.score(road, drive.time_us, drive.ego[0])
    with pytest.raises(ValueError, match="ego: expected 11 along axis 1"):
        gump.nuplan.score(road, drive.time_us, drive.ego[:, :5])
    with pytest.raises(ValueError, match="ego: expected 19 along axis 0|ego: expected .* along axis 0"):
        gump.nuplan.score(road, drive.time_us[1:], drive.ego)
    with pytest.raises(ValueError, match="expected agent_id to name agents of its present or future, found 987654"):
        gump.nuplan.score(road, drive.time_us, drive.ego, [987654], drive.others[:1])
    with pytest.raises(ValueError, match="agent_id, others: expected both or neither, found one"):
        gump.nuplan.score(road, drive.time_us, drive.ego, [1])
    with pytest.raises(ValueError):
        gump.nuplan.score(road, drive.time_us, drive.ego * np.nan)
    with pytest.raises(ValueError):
        gump.nuplan.score(road, drive.time_us[::-1], drive.ego)
    with pytest.raises(ValueError):
        gump.nuplan.score(road, drive.time_us[:0], drive.ego[:0])
