//! A drive by a planner across a socket, and every way in which one goes wrong.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use gump_nuplan::closed_loop::{DriveConfig, Driven, Recording, Replayed, Tracking, drive};
use gump_rollout::RolloutError;
use prost::Message as _;

use super::*;

/// Answer of the server to one call.
#[derive(Clone)]
enum Answer {
    Empty,
    /// States by seconds from now, the ego going on straight as it is.
    Ahead(Vec<f64>),
    NoPose,
    Error(&'static str),
    Silence,
}

/// A server for one connection: calls get the answers in turn, the last one repeatedly. It
/// implements only the HTTP/2 that successive unary calls need.
fn serve(answers: Vec<Answer>) -> (String, Receiver<Vec<u8>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (sender, requests) = channel();
    std::thread::spawn(move || {
        if let Ok((stream, _)) = listener.accept() {
            // The client may disconnect at any time.
            let _ = talk(stream, &answers, &sender);
        }
    });
    (address, requests)
}

fn talk(
    mut stream: TcpStream,
    answers: &[Answer],
    sender: &Sender<Vec<u8>>,
) -> std::io::Result<()> {
    stream.read_exact(&mut [0; 24])?;
    stream.write_all(&frame(4, 0, 0, &[]))?;
    let (mut body, mut calls) = (Vec::new(), 0);
    loop {
        let mut head = [0; 9];
        stream.read_exact(&mut head)?;
        let mut payload = vec![0; u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize];
        stream.read_exact(&mut payload)?;
        let (kind, flags) = (head[3], head[4]);
        let id = u32::from_be_bytes([head[5], head[6], head[7], head[8]]);
        match kind {
            0 => {
                let room = (payload.len() as u32).to_be_bytes();
                if !payload.is_empty() {
                    stream.write_all(&frame(8, 0, 0, &room))?;
                }
                body.extend(payload);
                if flags & 1 == 1 {
                    let request = std::mem::take(&mut body);
                    let answer = &answers[calls.min(answers.len() - 1)];
                    calls += 1;
                    stream.write_all(&response(answer, id, &request[5..]))?;
                    let _ = sender.send(request[5..].to_vec());
                }
            }
            4 | 6 if flags & 1 == 0 => {
                let echo = if kind == 6 { &payload[..] } else { &[] };
                stream.write_all(&frame(kind, 1, 0, echo))?;
            }
            _ => {}
        }
    }
}

fn frame(kind: u8, flags: u8, id: u32, payload: &[u8]) -> Vec<u8> {
    let mut frame = (payload.len() as u32).to_be_bytes()[1..].to_vec();
    frame.extend([kind, flags]);
    frame.extend(id.to_be_bytes());
    frame.extend(payload);
    frame
}

/// Headers that need no table.
fn headers(pairs: &[(&str, &str)]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (name, value) in pairs {
        bytes.extend([0, name.len() as u8]);
        bytes.extend(name.as_bytes());
        bytes.push(value.len() as u8);
        bytes.extend(value.as_bytes());
    }
    bytes
}

fn response(answer: &Answer, id: u32, request: &[u8]) -> Vec<u8> {
    let message = match answer {
        Answer::Silence => return Vec::new(),
        Answer::Empty | Answer::Error(_) => Vec::new(),
        Answer::Ahead(seconds) => ahead(request, seconds).encode_to_vec(),
        Answer::NoPose => {
            let mut plan = ahead(request, &[0.0, 1.0]);
            plan.ego_states[1].rear_axle_pose = None;
            plan.encode_to_vec()
        }
    };
    let mut opening = vec![0x88];
    opening.extend(headers(&[("content-type", "application/grpc")]));
    let mut bytes = frame(1, 4, id, &opening);
    let end = match answer {
        Answer::Error(why) => headers(&[("grpc-status", "13"), ("grpc-message", why)]),
        _ => {
            let mut body = vec![0];
            body.extend((message.len() as u32).to_be_bytes());
            body.extend(message);
            bytes.extend(frame(0, 0, id, &body));
            headers(&[("grpc-status", "0")])
        }
    };
    bytes.extend(frame(1, 5, id, &end));
    bytes
}

/// Along the x axis at 5 m/s from x = 10.
fn ahead(request: &[u8], seconds: &[f64]) -> proto::Trajectory {
    let input = proto::PlannerInput::decode(request).unwrap();
    let now_us = input.simulation_iteration.unwrap().time_us;
    let state = |&seconds: &f64| {
        let time_us = now_us + (seconds * 1e6) as i64;
        proto::EgoState {
            rear_axle_pose: Some(proto::StateSe2 {
                x: (time_us - 200_000) as f32 * 5e-6 + 10.0,
                ..proto::StateSe2::default()
            }),
            rear_axle_velocity_2d: Some(proto::StateVector2D { x: 5.0, y: 0.0 }),
            time_us,
            ..proto::EgoState::default()
        }
    };
    proto::Trajectory {
        ego_states: seconds.iter().map(state).collect(),
    }
}

fn recording() -> Recording {
    let mut scenario = gump_scene::fixture::scenario(
        "lane 7: 0,0 300,0
         route 7
         ego vehicle 0: 10,0 velocity 5,0
         agent vehicle 1: 60,0
         agent pedestrian 2: 60,9
         light 7 red",
    )
    .unwrap();
    let present = scenario.log[scenario.now].clone();
    // Two frames before, one and a half seconds after.
    scenario.log = vec![present; 18];
    scenario.now = 2;
    Recording::of_boxes(scenario).unwrap()
}

fn driven(address: &str, limit: Duration) -> Result<Driven, RolloutError> {
    let mut driver = RemoteDriver::new(address, "a-town", Some(limit));
    let config = DriveConfig {
        tracking: Tracking::Perfect,
        seconds: 1.0,
        keep_plans: false,
    };
    drive(&recording(), &mut Replayed, &mut driver, &config)
}

fn check(answers: Vec<Answer>, limit: Duration, expected: &str) {
    let (address, _requests) = serve(answers);
    let error = driven(&address, limit).unwrap_err().to_string();
    let expected = expected.replace("ADDRESS", &address);
    assert_eq!(error, expected);
}

const LONG: Duration = Duration::from_secs(20);

#[test]
fn a_planner_across_a_socket_drives() {
    let (address, requests) = serve(vec![Answer::Empty, Answer::Ahead(vec![0.0, 0.5, 1.0])]);
    let driven = driven(&address, LONG).unwrap();
    let last = driven.ego.last().unwrap();
    assert_eq!(driven.ego.len(), 10);
    assert!((last.rear_axle.position.x - 14.5).abs() < 1e-4, "{last:?}");

    let began = requests.recv().unwrap();
    let began = proto::PlannerInitializationLight::decode(&began[..]).unwrap();
    assert_eq!(began.map_name, "a-town");
    assert!(began.mission_goal.is_some());
    let inputs = requests.iter().take(10);
    let inputs = inputs.map(|bytes| proto::PlannerInput::decode(&bytes[..]).unwrap());
    let inputs: Vec<_> = inputs.collect();
    let buffer = |i: usize| inputs[i].simulation_history_buffer.as_ref().unwrap();
    // The past once, then the present alone.
    assert_eq!(
        (buffer(0).ego_states.len(), buffer(0).observations.len()),
        (3, 3)
    );
    assert_eq!(
        (buffer(9).ego_states.len(), buffer(9).observations.len()),
        (1, 1)
    );
    assert_eq!(buffer(0).sample_interval, Some(0.1));
    assert_eq!(buffer(9).sample_interval, None);
    let step = inputs[9].simulation_iteration.unwrap();
    assert_eq!((step.index, step.time_us), (9, 1_100_000));
    let light = &inputs[0].traffic_light_data[0];
    assert_eq!(light.status.as_ref().unwrap().status_name, "RED");
    assert_eq!(light.lane_connector_id, 7);
}

#[test]
fn what_goes_wrong_is_one_sentence() {
    let silent = Duration::from_millis(50);
    check(
        vec![Answer::Empty, Answer::Silence],
        silent,
        "iteration 0: grpc:ADDRESS: expected an answer to ComputeTrajectory within 0.05 s, found none",
    );
    check(
        vec![Answer::Error("no such map")],
        LONG,
        "iteration 0: grpc:ADDRESS: expected an answer to InitializePlanner, found the error \
         Internal: no such map",
    );
    check(
        vec![
            Answer::Empty,
            Answer::Ahead(vec![0.0, 1.0]),
            Answer::Error("lost"),
        ],
        LONG,
        "iteration 1: grpc:ADDRESS: expected an answer to ComputeTrajectory, found the error \
         Internal: lost",
    );
    check(
        vec![Answer::Empty, Answer::NoPose],
        LONG,
        "iteration 0: grpc:ADDRESS: state 1 of the trajectory: expected a rear_axle_pose, found none",
    );
    let too_few = RolloutError::TooFewStates(1).to_string();
    check(
        vec![Answer::Empty, Answer::Ahead(vec![0.0])],
        LONG,
        &format!("iteration 0: grpc:ADDRESS: {too_few}"),
    );
    check(
        vec![Answer::Empty, Answer::Ahead(vec![0.2, 1.0])],
        LONG,
        "iteration 0: grpc:ADDRESS: expected a trajectory over 200000 to 300000 µs, found one over \
         400000 to 1200000",
    );
}

#[test]
fn nobody_is_there() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    drop(listener);
    let error = driven(&address, LONG).unwrap_err().to_string();
    let expected =
        format!("iteration 0: grpc:{address}: expected a planner at {address}, found none: ");
    assert!(error.starts_with(&expected), "{error}");
}

#[test]
fn a_pickle_calls_the_devkits_constructors() {
    let recording = recording();
    let ego = pickle::ego_state(recording.ego_at(0), recording.vehicle());
    assert_eq!(
        (ego[..2].to_vec(), ego.last()),
        (vec![0x80, 4], Some(&b'.'))
    );
    let frame = &recording.scenario().log[2];
    let text = String::from_utf8_lossy(&pickle::detections(frame, recording.scenario().ego, 5))
        .into_owned();
    // Said once, remembered afterwards.
    assert_eq!(text.matches("SceneObjectMetadata").count(), 1);
    assert_eq!(text.matches("TrackedObjectType.PEDESTRIAN").count(), 1);
    assert!(!text.contains("StaticObject"));
}

#[test]
fn lanes_beyond_the_protocol_are_told() {
    let error = RemoteError::Lane(1 << 40).to_string();
    assert!(error.contains("lane 1099511627776"), "{error}");
}
