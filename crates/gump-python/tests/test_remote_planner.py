"""The driver drives the example planner across nuPlan's planner protocol, and says what goes wrong."""

import json
import os
import socket
import subprocess
import sys
from types import SimpleNamespace

import pytest

import gump
from conftest import MINI, REPOSITORY

SCENES = MINI / "procedural.tfrecord.gz"


@pytest.fixture(scope="module")
def planners():
    """The example, which wants gRPC's own package."""
    for package in ("grpc", "grpc_tools"):
        pytest.importorskip(package, reason=f"the planner protocol wants the package {package}, found none")
    sys.path.insert(0, str(REPOSITORY / "python"))
    import nuplan_planner

    return nuplan_planner


@pytest.fixture
def evaluate(tmp_path):
    """Runs `evaluate closed-loop` with a planner at a port: its report, and what it says of errors."""
    driver = os.environ.get("GUMP_XTASK")
    if driver is None:
        pytest.skip("GUMP_XTASK does not name the driver")

    def run(port, *more):
        words = ["evaluate", "closed-loop", "--scenarios", str(SCENES), "--limit", "2", "--world", "log"]
        words += ["--planner", f"grpc:127.0.0.1:{port}", "--seconds", "3", "--films", "0", "--out", str(tmp_path), *more]
        done = subprocess.run([driver, *words], capture_output=True, text=True)
        if "expected a build with the feature grpc" in done.stderr:
            pytest.skip("the driver was built without the feature grpc")
        report = tmp_path / "report.json"
        return (json.loads(report.read_text()) if report.exists() else None), done.stderr

    return run


def test_the_example_drives_as_it_would_in_process(planners, evaluate):
    class Here:
        def initialize(self, initialization):
            pass

        def compute_planner_trajectory(self, current_input):
            ego = current_input.ego
            pose, speed = SimpleNamespace(x=ego.x, y=ego.y, heading=ego.heading), SimpleNamespace(x=ego.velocity_x)
            return planners.Cruise().plan([SimpleNamespace(rear_axle=pose, velocity=speed)], [], [])[1:]

    server, port = planners.serve(planners.Cruise())
    report, error = evaluate(port)
    server.stop(None)
    assert report is not None, error
    scenarios = report["results"]["scenarios"]
    assert len(scenarios) == 2
    reader = gump.open(SCENES)
    for told in scenarios:
        here = gump.nuplan.simulate(next(reader), Here(), "log", seconds=3.0)
        # The protocol rounds to 32 bits.
        assert told["score"] == pytest.approx(here.score, abs=0.02)


def test_a_planner_sees_what_it_should(planners, evaluate):
    seen = []

    class Watches(planners.Cruise):
        def initialize(self, *mission):
            super().initialize(*mission)
            self.goal = mission[1]

        def plan(self, egos, observations, lights):
            seen.append((list(egos), list(observations), lights))
            return super().plan(egos, observations, lights)

    server, port = planners.serve(Watches())
    report, error = evaluate(port, "--limit", "1")
    server.stop(None)
    assert report is not None, error
    scenario = next(gump.open(SCENES))
    egos, observations, _ = seen[0]
    assert len(egos) == len(observations) == min(scenario.now + 1, 22)
    assert len(seen[-1][0]) == len(egos) + len(seen) - 1
    others = observations[-1].tracked_objects.tracked_objects
    assert len(others) == len(scenario.simulated) - 1
    assert {other.tracked_object_type for other in others} <= {"VEHICLE", "PEDESTRIAN", "BICYCLE", "GENERIC_OBJECT"}
    assert egos[-1].vehicle.wheel_base > 1.0
    times = [ego.time_point.time_us for ego in seen[-1][0]]
    assert times == sorted(set(times))


def test_a_planner_that_raises_fails_its_scenarios(planners, evaluate):
    class Fails(planners.Cruise):
        def plan(self, egos, observations, lights):
            raise ValueError("lost the way")

    server, port = planners.serve(Fails())
    report, error = evaluate(port)
    server.stop(None)
    told = "expected an answer to ComputeTrajectory, found the error Unknown: Exception calling application: lost the way"
    assert told in error or all(told in one["error"] for one in report["results"]["scenarios"])


def test_nobody_is_there(evaluate):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    report, error = evaluate(port)
    told = f"expected a planner at 127.0.0.1:{port}, found none"
    assert told in error or all(told in one["error"] for one in report["results"]["scenarios"])


def test_no_code_of_a_pickle_runs(planners):
    import pickle

    class Evil:
        def __reduce__(self):
            return print, ("ran",)

    with pytest.raises(pickle.UnpicklingError, match="expected a class of nuPlan's states, found builtins.print"):
        planners.unpickle(pickle.dumps(Evil()))
