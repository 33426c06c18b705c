//! The protocol, spoken well and badly; and the Python client, where there is a Python.

#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};

use common::{busy, config, env};
use gump_rl::server::{Event, Server, ServerError};
use gump_rl::{PreparedScenario, TrafficSource, VectorEnv};
use gump_scene::Seed;

const N: usize = 3;

/// A place for a socket, short enough for one.
fn socket(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("gump-rl-{}-{name}", std::process::id()))
}

/// Runs a server on the log while `talk` talks to it; returns its events.
fn with_server(
    name: &str,
    prepared: &Arc<[PreparedScenario]>,
    talk: impl FnOnce(&Path),
) -> Vec<Event> {
    let path = socket(name);
    let server = Server::bind(&path).unwrap();
    let events = Mutex::new(Vec::new());
    let record = |event| events.lock().unwrap().push(event);
    std::thread::scope(|scope| {
        let run = || server.run(prepared, TrafficSource::Log, &config(1), &record);
        let running = scope.spawn(run);
        let stop = StopOnDrop(&server);
        talk(&path);
        drop(stop);
        running.join().unwrap().unwrap();
    });
    drop(server);
    assert!(!path.exists());
    events.into_inner().unwrap()
}

/// Ends the server when a test fails, too.
struct StopOnDrop<'a>(&'a Server);

impl Drop for StopOnDrop<'_> {
    fn drop(&mut self) {
        self.0.stop();
    }
}

fn frame(kind: u8, body: &[u8]) -> Vec<u8> {
    let mut frame = (body.len() as u32).to_le_bytes().to_vec();
    frame.push(kind);
    frame.extend_from_slice(body);
    frame
}

fn hello(rows: u32, autoreset: u8) -> Vec<u8> {
    let mut body = b"GUMP\x01\x00".to_vec();
    body.extend([autoreset, 0, 0]);
    body.extend(rows.to_le_bytes());
    frame(1, &body)
}

struct Client(UnixStream);

impl Client {
    fn connect(path: &Path) -> Self {
        Self(UnixStream::connect(path).unwrap())
    }

    /// A client that has been welcomed, with `N` rows.
    fn greeted(path: &Path, autoreset: u8) -> Self {
        let mut client = Self::connect(path);
        let (kind, body) = client.ask(&hello(N as u32, autoreset));
        assert_eq!(kind, 65);
        assert_eq!(body[..8], [3, 0, 0, 0, 2, 0, 0, 0]);
        assert_eq!(body[8..16], 0.5f64.to_le_bytes());
        client
    }

    fn ask(&mut self, request: &[u8]) -> (u8, Vec<u8>) {
        self.0.write_all(request).unwrap();
        self.answer()
    }

    fn answer(&mut self) -> (u8, Vec<u8>) {
        let mut header = [0; 5];
        self.0.read_exact(&mut header).unwrap();
        let [a, b, c, d, kind] = header;
        let mut body = vec![0; u32::from_le_bytes([a, b, c, d]) as usize];
        self.0.read_exact(&mut body).unwrap();
        (kind, body)
    }

    /// True if the server has hung up.
    fn is_over(&mut self) -> bool {
        matches!(self.0.read(&mut [0]), Ok(0) | Err(_))
    }

    fn reset(&mut self, seeds: [u64; N]) -> Vec<f32> {
        let mut body = vec![1];
        for seed in seeds {
            body.extend(seed.to_le_bytes());
        }
        let (kind, body) = self.ask(&frame(2, &body));
        assert_eq!(kind, 66);
        numbers(&body)
    }

    fn step(&mut self, actions: &[f32]) -> (u8, Vec<u8>) {
        let body: Vec<u8> = actions.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.ask(&frame(3, &body))
    }

    fn refused(&mut self, request: &[u8]) -> (u8, String) {
        let (kind, body) = self.ask(request);
        assert_eq!(kind, 127);
        (body[0], String::from_utf8(body[1..].to_vec()).unwrap())
    }
}

fn numbers(body: &[u8]) -> Vec<f32> {
    let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    body.chunks_exact(4).map(number).collect()
}

/// Returns the farewell of the only client.
fn farewell(events: &[Event]) -> &gump_rl::server::Farewell {
    match events {
        [
            Event::Came { client: 0 },
            Event::Left {
                client: 0,
                farewell,
            },
        ] => farewell,
        _ => panic!("{events:?}"),
    }
}

#[test]
fn a_client_sees_what_the_environment_shows() {
    let prepared = busy(4);
    let mut own = env(&prepared, TrafficSource::Log, N);
    own.reset_with(&[Seed(7), Seed(8), Seed(9)]).unwrap();
    let events = with_server("sees", &prepared, |path| {
        let mut client = Client::greeted(path, 1);
        assert_eq!(client.reset([7, 8, 9]), own.observations());
        for _ in 0..20 {
            let actions = [0.4, 0.1, -0.2, 0.0, 0.9, -0.3];
            let (kind, body) = client.step(&actions);
            own.step(&actions).unwrap();
            assert_eq!(kind, 67);
            let (observations, rest) = body.split_at(own.observations().len() * 4);
            assert_eq!(numbers(observations), own.observations());
            let (rewards, rest) = rest.split_at(4 * N);
            assert_eq!(numbers(rewards), own.rewards());
            let flags = |flags: &[bool]| flags.iter().map(|f| u8::from(*f)).collect::<Vec<_>>();
            let expected = [own.terminated(), own.truncated(), own.restarted()];
            assert_eq!(rest[..3 * N], expected.map(flags).concat());
            let n = own.finished().len();
            assert_eq!(rest[3 * N..3 * N + 4], (n as u32).to_le_bytes());
            let len = own.observation_len();
            assert_eq!(rest.len(), 3 * N + 4 + n * (12 + 8 + 3 + 4 * len));
            if let Some((row, outcome)) = own.finished().first() {
                let first = &rest[3 * N + 4..];
                assert_eq!(first[..4], (*row as u32).to_le_bytes());
                assert_eq!(first[8..12], (outcome.steps as u32).to_le_bytes());
                let last = numbers(&first[23..23 + 4 * len]);
                assert_eq!(last, own.final_observations()[row * len..][..len]);
            }
        }
        client.0.write_all(&frame(4, &[])).unwrap();
        assert!(client.is_over());
    });
    let farewell = farewell(&events);
    assert!(farewell.error.is_none() && farewell.episodes_finished >= 3);
}

#[test]
fn refusals_change_nothing_and_the_talk_goes_on() {
    let prepared = busy(2);
    with_server("refusals", &prepared, |path| {
        let mut client = Client::greeted(path, 2);
        let mut untouched = Client::greeted(path, 2);
        let (code, what) = client.refused(&frame(3, &[0; 24]));
        assert_eq!(code, 2);
        assert_eq!(
            what,
            "the environment has no episodes in progress, reset it first"
        );
        client.reset([1, 2, 3]);
        untouched.reset([1, 2, 3]);
        let mut bad = [0.0f32; 6];
        bad[3] = f32::NAN;
        let body: Vec<u8> = bad.iter().flat_map(|v| v.to_le_bytes()).collect();
        let (code, what) = client.refused(&frame(3, &body));
        assert_eq!(code, 2);
        assert_eq!(what, "the action of row 1 is not a finite number");
        let (kind, after) = client.step(&[0.0; 6]);
        assert_eq!(kind, 67);
        assert_eq!(after, untouched.step(&[0.0; 6]).1);
        // Row 1 alone begins anew.
        let (kind, body) = client.ask(&frame(2, &[2, 0, 1, 0]));
        assert_eq!((kind, body.len()), (66, after.len() - 4 * N - 3 * N - 4));
    });
}

/// Sends garbage; returns the message of the server and the error it hung up with.
fn garbage(name: &str, greeted: bool, bytes: &[u8]) -> (String, ServerError) {
    let prepared = busy(1);
    let mut message = String::new();
    let mut events = with_server(name, &prepared, |path| {
        let mut client = if greeted {
            Client::greeted(path, 1)
        } else {
            Client::connect(path)
        };
        let (code, what) = client.refused(bytes);
        assert_eq!(code, 1);
        assert!(client.is_over());
        message = what;
        // The server lives on.
        Client::greeted(path, 1).reset([1, 2, 3]);
    });
    let of_first = |event: &Event| matches!(event, Event::Left { client: 0, .. });
    let left = events.iter().position(of_first).unwrap();
    match events.swap_remove(left) {
        Event::Left { farewell, .. } => (message, farewell.error.unwrap()),
        _ => unreachable!("it was found by its kind"),
    }
}

#[test]
fn garbage_is_answered_and_the_server_lives_on() {
    let greeting = |name, bytes: &[u8]| {
        let (message, error) = garbage(name, false, bytes);
        assert!(matches!(error, ServerError::Greeting { version: 1 }));
        assert_eq!(message, error.to_string());
    };
    greeting("http", b"GET / HTTP/1.1\r\n\r\n");
    greeting(
        "version",
        &frame(1, b"GUMP\x02\x00\x00\x00\x00\x01\x00\x00\x00"),
    );
    greeting("early", &frame(3, &[0; 24]));

    let (message, error) = garbage("many", false, &hello(1_000_000, 0));
    assert!(matches!(error, ServerError::Choice { most: 4096, .. }));
    assert!(message.contains("number of rows is 1000000"), "{message}");
    let (_, error) = garbage("mode", false, &hello(2, 9));
    assert!(matches!(error, ServerError::Choice { found: 9, .. }));
    let (_, error) = garbage("kind", true, &frame(77, &[]));
    assert!(matches!(error, ServerError::Kind { found: 77, .. }));
    let (message, error) = garbage("length", true, &frame(3, &[0; 5]));
    assert!(matches!(
        error,
        ServerError::Length {
            expected: 24,
            found: 5,
            ..
        }
    ));
    assert_eq!(message, "a step has 24 bytes, found 5");
    // A client cannot make the server allocate 4 GiB.
    let (_, error) = garbage("huge", true, &[255, 255, 255, 255, 2]);
    assert!(matches!(error, ServerError::Length { what: "reset", .. }));
    let (_, error) = garbage("reset", true, &frame(2, &[7]));
    assert!(matches!(error, ServerError::Choice { found: 7, .. }));
}

#[test]
fn a_client_may_vanish_within_a_step() {
    let prepared = busy(2);
    let events = with_server("vanish", &prepared, |path| {
        let mut client = Client::greeted(path, 1);
        client.reset([1, 2, 3]);
        client.step(&[0.0; 6]);
        client.0.write_all(&frame(3, &[0; 24])[..11]).unwrap();
        drop(client);
        // The next one is served.
        let mut next = Client::greeted(path, 1);
        next.reset([1, 2, 3]);
        next.0.write_all(&frame(4, &[])).unwrap();
        assert!(next.is_over());
    });
    let first = events.iter().find_map(|event| match event {
        Event::Left {
            client: 0,
            farewell,
        } => Some(farewell),
        _ => None,
    });
    let farewell = first.unwrap();
    assert!(matches!(
        farewell.error,
        Some(ServerError::Disconnected {
            during: "within a request"
        })
    ));
    assert_eq!(farewell.episodes_lost, 3);
}

#[test]
fn one_socket_has_one_server() {
    let path = socket("one");
    let server = Server::bind(&path).unwrap();
    let second = Server::bind(&path);
    assert!(matches!(second, Err(ServerError::InUse(_))));
    drop(server);
    // What a server that died left behind is replaced, a file is not.
    drop(std::os::unix::net::UnixListener::bind(&path).unwrap());
    assert!(path.exists());
    drop(Server::bind(&path).unwrap());
    std::fs::write(&path, "mine").unwrap();
    assert!(matches!(
        Server::bind(&path),
        Err(ServerError::Listen { .. })
    ));
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "mine");
    std::fs::remove_file(&path).unwrap();
}

/// Needs python3 with numpy; with gymnasium and stable-baselines3 it tests more. `GUMP_PYTHON`
/// names another interpreter.
#[test]
fn the_python_client_works() {
    let python = std::env::var_os("GUMP_PYTHON").unwrap_or_else(|| "python3".into());
    let numpy = Command::new(&python).args(["-c", "import numpy"]).output();
    if !numpy.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: no python3 with numpy here");
        return;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../python/test_gump_env.py");
    with_server("python", &busy(8), |path| {
        let output = Command::new(&python).arg(&script).arg(path).output();
        let output = output.unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        eprintln!("{}{stderr}", String::from_utf8_lossy(&output.stdout));
        assert!(output.status.success(), "{stderr}");
    });
}
