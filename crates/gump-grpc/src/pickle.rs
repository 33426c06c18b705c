//! Pickles for nuPlan's planners: an `EgoState` and a `DetectionsTracks` of nuplan-devkit.
//!
//! The protocol carries both as pickled Python objects. These pickles (protocol 4) do not list
//! attributes of the devkit's classes but call their constructors, by name and in the order of their
//! arguments. So they open wherever the devkit is installed, and can be read without it by an
//! `Unpickler` that knows these dozen names; `python/nuplan_planner.py` does.

use gump_geometry::{DVec2, Pose};
use gump_scene::{Agent, AgentId, AgentKind, EgoState, Frame, VehicleParameters};

const STATES: &str = "nuplan.common.actor_state.state_representation";
const KINDS: &str = "nuplan.common.actor_state.tracked_objects_types";

/// The ego at one moment, an `EgoState`.
pub(super) fn ego_state(ego: &EgoState, vehicle: &VehicleParameters) -> Vec<u8> {
    let module = "nuplan.common.actor_state.ego_state";
    let mut pickle = Pickle::default();
    pickle.call(module, "EgoState.build_from_rear_axle", |p| {
        p.pose(ego.rear_axle);
        p.vector(ego.velocity);
        p.vector(ego.acceleration);
        p.float(ego.steering_angle);
        p.call(STATES, "TimePoint", |p| p.integer(ego.time_us));
        p.vehicle(vehicle);
        // Whether it drives by itself.
        p.yes();
        p.float(ego.yaw_rate);
        p.float(ego.yaw_acceleration);
        p.float(ego.steering_rate);
    });
    pickle.done()
}

/// All agents but the ego at one moment, a `DetectionsTracks`.
pub(super) fn detections(frame: &Frame, ego: AgentId, time_us: i64) -> Vec<u8> {
    let mut pickle = Pickle::default();
    let module = "nuplan.planning.simulation.observation.observation_type";
    pickle.call(module, "DetectionsTracks", |p| {
        let module = "nuplan.common.actor_state.tracked_objects";
        p.call(module, "TrackedObjects", |p| {
            let others = frame.agents().iter().filter(|agent| agent.id != ego);
            p.list(others, |p, agent| p.agent(agent, time_us));
        });
    });
    pickle.done()
}

/// Instructions of a pickle machine, which leave one object.
struct Pickle {
    bytes: Vec<u8>,
    /// Names already written, by their index in the memo of the pickle machine.
    names: Vec<(&'static str, &'static str)>,
}

impl Default for Pickle {
    fn default() -> Self {
        Self {
            bytes: vec![0x80, 4],
            names: Vec::new(),
        }
    }
}

impl Pickle {
    fn done(mut self) -> Vec<u8> {
        self.bytes.push(b'.');
        self.bytes
    }

    /// Pushes a class, or a member of one.
    fn name(&mut self, module: &'static str, name: &'static str) {
        if let Some(i) = self.names.iter().position(|&known| known == (module, name)) {
            self.bytes.extend([b'h', i as u8]);
            return;
        }
        self.text(module);
        self.text(name);
        self.bytes.extend([0x93, 0x94]);
        self.names.push((module, name));
    }

    /// Pushes the result of calling a class or function with some arguments.
    fn call(
        &mut self,
        module: &'static str,
        name: &'static str,
        arguments: impl FnOnce(&mut Self),
    ) {
        self.name(module, name);
        self.bytes.push(b'(');
        arguments(self);
        self.bytes.extend(b"tR");
    }

    fn list<T>(&mut self, items: impl Iterator<Item = T>, mut item: impl FnMut(&mut Self, T)) {
        self.bytes.extend(b"](");
        for one in items {
            item(self, one);
        }
        self.bytes.push(b'e');
    }

    /// At most 255 bytes: names of the devkit and numbers.
    fn text(&mut self, text: &str) {
        self.bytes.extend([0x8c, text.len() as u8]);
        self.bytes.extend(text.as_bytes());
    }

    fn float(&mut self, value: f64) {
        self.bytes.push(b'G');
        self.bytes.extend(value.to_be_bytes());
    }

    fn integer(&mut self, value: i64) {
        self.bytes.extend([0x8a, 8]);
        self.bytes.extend(value.to_le_bytes());
    }

    fn yes(&mut self) {
        self.bytes.push(0x88);
    }

    fn pose(&mut self, pose: Pose) {
        self.call(STATES, "StateSE2", |p| {
            p.float(pose.position.x);
            p.float(pose.position.y);
            p.float(pose.heading);
        });
    }

    fn vector(&mut self, vector: DVec2) {
        self.call(STATES, "StateVector2D", |p| {
            p.float(vector.x);
            p.float(vector.y);
        });
    }

    fn vehicle(&mut self, vehicle: &VehicleParameters) {
        let module = "nuplan.common.actor_state.vehicle_parameters";
        // The devkit's own car keeps the names it has there.
        let (name, kind) = match *vehicle == VehicleParameters::PACIFICA {
            true => ("pacifica", "gen1"),
            false => ("ego", "recorded"),
        };
        self.call(module, "VehicleParameters", |p| {
            p.float(vehicle.width);
            p.float(vehicle.front_length);
            p.float(vehicle.rear_length);
            p.float(vehicle.center_of_gravity);
            p.float(vehicle.wheel_base);
            p.text(name);
            p.text(kind);
            p.float(vehicle.height);
        });
    }

    fn agent(&mut self, agent: &Agent, time_us: i64) {
        let (module, name) = match agent.kind.is_moving() {
            true => ("nuplan.common.actor_state.agent", "Agent"),
            false => ("nuplan.common.actor_state.static_object", "StaticObject"),
        };
        self.call(module, name, |p| {
            p.name(KINDS, kind(agent.kind));
            p.footprint(agent);
            if agent.kind.is_moving() {
                p.vector(agent.state.velocity);
            }
            p.metadata(agent.id, time_us);
        });
    }

    fn footprint(&mut self, agent: &Agent) {
        let module = "nuplan.common.actor_state.oriented_box";
        self.call(module, "OrientedBox", |p| {
            p.pose(agent.state.pose);
            p.float(agent.length);
            p.float(agent.width);
            p.float(agent.height);
        });
    }

    fn metadata(&mut self, id: AgentId, time_us: i64) {
        let module = "nuplan.common.actor_state.scene_object";
        let token = id.0.to_string();
        self.call(module, "SceneObjectMetadata", |p| {
            p.integer(time_us);
            p.text(&token);
            p.integer(id.0);
            p.text(&token);
        });
    }
}

/// nuPlan's kind of an agent.
fn kind(kind: AgentKind) -> &'static str {
    match kind {
        AgentKind::Vehicle => "TrackedObjectType.VEHICLE",
        AgentKind::Pedestrian => "TrackedObjectType.PEDESTRIAN",
        AgentKind::Bicycle => "TrackedObjectType.BICYCLE",
        AgentKind::TrafficCone => "TrackedObjectType.TRAFFIC_CONE",
        AgentKind::Barrier => "TrackedObjectType.BARRIER",
        AgentKind::Sign => "TrackedObjectType.CZONE_SIGN",
        AgentKind::Other => "TrackedObjectType.GENERIC_OBJECT",
    }
}
