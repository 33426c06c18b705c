//! The loop of `rl serve`: counts what is served until Ctrl-C.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use gump_engine::SamplingConfig;
use gump_eval::datasets::Split;
use gump_rl::server::{Event, Server};
use gump_rl::{EnvConfig, PreparedScenario, Sampling, TrafficSource};

use super::Args;
use crate::cli::WrongArguments;
use crate::run::{Run, interrupted};
use crate::verbs::rl::{PreparedSet, RlWorld};

impl Args {
    pub(crate) fn execute(&self, run: &mut Run) -> anyhow::Result<()> {
        if !(self.horizon > 0.0 && self.horizon.is_finite()) {
            let wrong = format!(
                "--horizon: expected a number above 0, found {}",
                self.horizon
            );
            return Err(WrongArguments(wrong).into());
        }
        let prepared = PreparedSet::read(run, &self.scenarios, Split::Train, self.limit)?.scenarios;
        let mut config = EnvConfig::default();
        let world = run.phase("load", |run| {
            let sampling = SamplingConfig::default();
            RlWorld::load(run.device(), &self.world, &sampling, config.live_lights)
        })?;
        config.rules.horizon = self.horizon;
        if self.prioritized {
            config.sampling = Sampling::prioritized();
        }
        let server = Server::bind(&self.socket)?;
        run.print(&format!(
            "serving {} scenarios at {}; Ctrl-C ends it",
            prepared.len(),
            server.path().display()
        ));
        let served = run.phase("serve", |run| {
            serve(run, &server, &prepared, world.traffic(), &config)
        })?;
        run.result("scenarios", prepared.len())?;
        run.result("clients", served.clients.into_inner())?;
        run.result("episodes", served.episodes.into_inner())?;
        run.result("episodes_lost", served.lost.into_inner())
    }
}

/// Counts of what was served.
#[derive(Default)]
struct Served {
    clients: AtomicU64,
    episodes: AtomicU64,
    lost: AtomicU64,
}

/// Serves until Ctrl-C.
fn serve(
    run: &Run,
    server: &Server,
    prepared: &Arc<[PreparedScenario]>,
    traffic: TrafficSource<'_>,
    config: &EnvConfig,
) -> anyhow::Result<Served> {
    let served = Served::default();
    let on_event = |event: Event| match event {
        Event::Came { client } => {
            served.clients.fetch_add(1, Ordering::Relaxed);
            run.print(&format!("client {client} came"));
        }
        Event::Left { client, farewell } => {
            let (n, lost) = (farewell.episodes_finished, farewell.episodes_lost as u64);
            served.episodes.fetch_add(n, Ordering::Relaxed);
            served.lost.fetch_add(lost, Ordering::Relaxed);
            let why = farewell
                .error
                .map_or_else(|| "it said goodbye".to_owned(), |error| error.to_string());
            run.print(&format!(
                "client {client} left after {n} episodes, {lost} under way: {why}"
            ));
        }
        // Neither counted nor reported.
        _ => {}
    };
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !interrupted() && !is_over.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(100));
            }
            server.stop();
        });
        let done = server.run(prepared, traffic, config, &on_event);
        is_over.store(true, Ordering::Relaxed);
        done
    })?;
    Ok(served)
}
