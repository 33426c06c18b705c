"""A planner in Python for `evaluate closed-loop --planner grpc:HOST:PORT`.

It serves nuPlan's planner protocol (`nuplan_planner.proto` beside this file) and plans without
nuplan-devkit. It wants grpcio and grpcio-tools:

    python nuplan_planner.py --port 50051
    cargo run -p xtask --features grpc -- evaluate closed-loop --scenarios FILE --planner grpc:localhost:50051

Put a planner of your own in place of `Cruise`: an object with `initialize` and `plan`. Servers made
with nuplan-devkit work as they are: the states that arrive are its own classes there.
"""

import argparse
import io
import math
import pickle
import sys
from concurrent import futures
from pathlib import Path
from types import SimpleNamespace

import grpc

sys.path.insert(0, str(Path(__file__).resolve().parent))
messages, services = grpc.protos_and_services("nuplan_planner.proto")

# What nuplan-devkit's classes are made of, in the order of their constructors.
_FIELDS = {
    "StateSE2": ("x", "y", "heading"),
    "StateVector2D": ("x", "y"),
    "TimePoint": ("time_us",),
    "VehicleParameters": (
        "width",
        "front_length",
        "rear_length",
        "cog_position_from_rear_axle",
        "wheel_base",
        "vehicle_name",
        "vehicle_type",
        "height",
    ),
    "EgoState.build_from_rear_axle": (
        "rear_axle",
        "velocity",
        "acceleration",
        "tire_steering_angle",
        "time_point",
        "vehicle",
        "is_in_auto_mode",
        "angular_velocity",
        "angular_acceleration",
        "tire_steering_rate",
    ),
    "OrientedBox": ("center", "length", "width", "height"),
    "SceneObjectMetadata": ("timestamp_us", "token", "track_id", "track_token"),
    "Agent": ("tracked_object_type", "box", "velocity", "metadata"),
    "StaticObject": ("tracked_object_type", "box", "metadata"),
    "TrackedObjects": ("tracked_objects",),
    "DetectionsTracks": ("tracked_objects",),
}


class _Plain(pickle.Unpickler):
    """Opens the pickles of the protocol into plain objects, and nothing else: no code of a pickle runs."""

    def find_class(self, module, name):
        if module.startswith("nuplan.") and name.startswith("TrackedObjectType."):
            return name.partition(".")[2]
        fields = _FIELDS.get(name) if module.startswith("nuplan.") else None
        if fields is None:
            raise pickle.UnpicklingError(f"expected a class of nuPlan's states, found {module}.{name}")
        return lambda *values: SimpleNamespace(**dict(zip(fields, values)))


def unpickle(data):
    """The plain form of an ego state or of detections; fields are those of `_FIELDS`."""
    return _Plain(io.BytesIO(data)).load()


class Cruise:
    """Goes straight on at the speed it has."""

    def initialize(self, route_roadblock_ids, mission_goal, map_name):
        """Told once per drive: names of roadblocks, x, y, heading, and nuPlan's name of the map or none."""
        self.route = list(route_roadblock_ids)

    def plan(self, egos, observations, lights):
        """Poses (x, y, heading of the rear axle) every tenth of a second from now on, the present first.

        `egos` and `observations` are all so far, oldest first; `lights` are lanes and colours.
        """
        ego = egos[-1]
        x, y, heading = ego.rear_axle.x, ego.rear_axle.y, ego.rear_axle.heading
        ahead = [0.1 * i * ego.velocity.x for i in range(41)]
        return [(x + s * math.cos(heading), y + s * math.sin(heading), heading) for s in ahead]


class Servicer(services.DetectionTracksChallengeServicer):
    """Calls a planner for whoever speaks the protocol."""

    def __init__(self, planner):
        self._planner = planner
        self._egos, self._observations = [], []

    def InitializePlanner(self, request, context):
        self._egos, self._observations = [], []
        goal = request.mission_goal
        self._planner.initialize(request.route_roadblock_ids, (goal.x, goal.y, goal.heading), request.map_name)
        return messages.Empty()

    def ComputeTrajectory(self, request, context):
        new = request.simulation_history_buffer
        self._egos += map(unpickle, new.ego_states)
        self._observations += map(unpickle, new.observations)
        lights = [(light.lane_connector_id, light.status.status_name) for light in request.traffic_light_data]
        poses = self._planner.plan(self._egos, self._observations, lights)
        return messages.Trajectory(ego_states=list(_states(self._egos[-1], poses)))


def _states(ego, poses):
    """Poses with speeds from their distances; the present keeps its own."""
    for i, (x, y, heading) in enumerate(poses):
        if i == 0:
            speed = ego.velocity.x
        else:
            speed = math.dist(poses[i][:2], poses[i - 1][:2]) / 0.1
        yield messages.EgoState(
            rear_axle_pose=messages.StateSE2(x=x, y=y, heading=heading),
            rear_axle_velocity_2d=messages.StateVector2D(x=speed),
            rear_axle_acceleration_2d=messages.StateVector2D(),
            time_us=ego.time_point.time_us + 100_000 * i,
        )


def serve(planner, port=0):
    """Serves a planner on this machine; the server, to be stopped, and its port (a free one for 0)."""
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=1))
    services.add_DetectionTracksChallengeServicer_to_server(Servicer(planner), server)
    port = server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    return server, port


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--port", type=int, default=50051)
    server, port = serve(Cruise(), parser.parse_args().port)
    print(f"serving on 127.0.0.1:{port}", flush=True)
    server.wait_for_termination()
