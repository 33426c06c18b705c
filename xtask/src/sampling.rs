//! Flags of a learned world's decoding.

use std::path::Path;

use gump_engine::{CacheMode, LightSource, Mode, Precision, Routes, SamplingConfig};
use gump_eval::decoding::Decoding;
use gump_eval::worlds::WorldName;
use gump_model::relative;
use serde::Serialize;

use crate::choices::{CACHES, LIGHTS, MODES, PRECISIONS, ROUTES, one_of};
use crate::cli::WrongArguments;

/// Flags of a learned world's decoding.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct Sampling {
    /// Decode all agents of a frame at once or one after another
    #[arg(long, value_parser = one_of(MODES), default_value_t = Mode::PartialAr)]
    mode: Mode,
    #[command(flatten)]
    #[serde(flatten)]
    pub(crate) draw: Draw,
}

/// Flags of a learned world's decoding that do not depend on the decoding order.
#[derive(Clone, Debug, Serialize, clap::Args)]
pub(crate) struct Draw {
    /// Key/value cache of the network
    #[arg(long, value_parser = one_of(CACHES), default_value_t = CacheMode::Window)]
    cache: CacheMode,
    /// Number format of the weights
    #[arg(long, value_parser = one_of(PRECISIONS), default_value_t = Precision::F32)]
    precision: Precision,
    /// Divides the logits; above 1 is more diverse [default: 0.5, and 1 of a relative network]
    #[arg(long, value_name = "X")]
    temperature: Option<f64>,
    /// Top-k sampling: bins per field that may be sampled [default: 40]
    #[arg(long, value_name = "N")]
    top_k: Option<usize>,
    /// Nucleus sampling: only the likeliest bins that together have this probability [default: 1,
    /// and 0.95 of a relative network, which cuts less off sideways moves and turns]
    #[arg(long, value_name = "X")]
    top_p: Option<f64>,
    /// Weight decay^age of earlier predictions of a moment, 0 for none [default: 0.3]
    #[arg(long, value_name = "X")]
    decay: Option<f64>,
    /// Resample colliding or off-road samples up to N times, 0 for never [default: 12]
    #[arg(long, value_name = "N")]
    redraws: Option<usize>,
    /// No kinematic limits: vehicles and bicycles may turn on the spot, slip sideways and stop at
    /// once, and people may be faster than a runner
    #[arg(long)]
    no_limits: bool,
    /// When the vehicles of a relative network are given routes, which they keep
    #[arg(long, value_name = "WHEN", value_parser = one_of(ROUTES), default_value_t = Routes::Late)]
    routes: Routes,
    /// The network alone: no move is drawn again or limited; intents are still drawn (--routes)
    #[arg(long)]
    raw: bool,
    /// The paper's decoding: temperature 1.1, decay 1.2, no rejection or limits; linear
    /// interpolation between frames, smoothed
    #[arg(long)]
    paper: bool,
    /// Only with rejection and limits, where tables otherwise show the network alone as well
    #[arg(long)]
    ruled: bool,
    /// Spawn and remove agents at the scene's boundary, as many as at the start
    #[arg(long = "spawn", alias = "life")]
    life: bool,
    /// Traffic lights after the present
    #[arg(long, value_parser = one_of(LIGHTS), default_value_t = LightSource::Model)]
    lights: LightSource,
}

impl Sampling {
    /// The model's form of the flags.
    ///
    /// Error: as [`Draw::resolve`].
    pub(crate) fn resolve(&self) -> anyhow::Result<SamplingConfig> {
        self.draw.resolve(self.mode)
    }

    /// As [`Self::resolve`], for some worlds.
    ///
    /// Error: as [`Self::resolve`] and [`Self::check`].
    pub(crate) fn resolve_for(&self, worlds: &[&WorldName]) -> anyhow::Result<SamplingConfig> {
        let config = self.resolve()?;
        self.check(worlds)?;
        Ok(config)
    }

    /// The decoding of a world.
    ///
    /// Error: as [`Draw::resolve`] and [`Self::check`].
    pub(crate) fn decoding(&self, world: &WorldName) -> anyhow::Result<Decoding> {
        let decoding = self.draw.decoding(self.mode)?;
        self.check(&[world])?;
        Ok(decoding.for_world(world))
    }

    /// Refuses flags that no world of a run has a use for.
    ///
    /// Error: [`WrongArguments`], or weights that cannot be read.
    pub(crate) fn check(&self, worlds: &[&WorldName]) -> anyhow::Result<()> {
        let learned = worlds.iter().filter_map(|world| match world {
            WorldName::Model(weights) => Some(weights.as_path()),
            _ => None,
        });
        let learned: Vec<&Path> = learned.collect();
        let given = self.given();
        let wrong = if let (true, Some((flag, _)), Some(found)) =
            (learned.is_empty(), given.first(), worlds.first())
        {
            format!(
                "{flag}: expected a learned world, model:WEIGHTS, found {found}, which decodes nothing"
            )
        } else if let (Some((flag, _)), Some(weights)) =
            (given.iter().find(|(_, alone)| *alone), learned.first())
        {
            for weights in &learned {
                if !relative::is_relative(weights)? {
                    return Ok(());
                }
            }
            format!(
                "{flag}: expected weights of a sequence network, found those of a relative network, \
                 which has no such setting: {}",
                weights.display()
            )
        } else {
            return Ok(());
        };
        Err(WrongArguments(wrong).into())
    }

    /// The flags of decoding that change something, and whether only a sequence network follows them.
    fn given(&self) -> Vec<(&'static str, bool)> {
        let draw = &self.draw;
        let flags = [
            ("--mode", true, self.mode != Mode::PartialAr),
            ("--cache", true, draw.cache != CacheMode::Window),
            ("--top-k", true, draw.top_k.is_some()),
            ("--decay", true, draw.decay.is_some()),
            ("--precision", false, draw.precision != Precision::F32),
            ("--temperature", false, draw.temperature.is_some()),
            ("--top-p", false, draw.top_p.is_some()),
            ("--redraws", false, draw.redraws.is_some()),
            ("--no-limits", false, draw.no_limits),
            ("--routes", false, draw.routes != Routes::Late),
            ("--raw", false, draw.raw),
            ("--paper", false, draw.paper),
        ];
        let given = flags.into_iter().filter(|(_, _, is_given)| *is_given);
        given.map(|(flag, alone, _)| (flag, alone)).collect()
    }

    /// Every decoding of a world that a table shows: for a network under rules also the network
    /// alone, unless the flags request one decoding.
    ///
    /// Error: as [`Draw::resolve`].
    pub(crate) fn decodings(&self, world: &WorldName) -> anyhow::Result<Vec<Decoding>> {
        match world {
            WorldName::Model(_) => self.draw.decodings(self.mode),
            _ => Ok(vec![self.draw.decoding(self.mode)?.for_world(world)]),
        }
    }
}

impl Draw {
    /// True if agents come and leave.
    pub(crate) fn has_life(&self) -> bool {
        self.life
    }

    /// The model's form of the flags.
    ///
    /// Error: [`WrongArguments`] for a number out of its range, or flags that contradict each other.
    pub(crate) fn resolve(&self, mode: Mode) -> anyhow::Result<SamplingConfig> {
        if let Some(wrong) = self.contradiction() {
            return Err(WrongArguments(wrong).into());
        }
        let base = match (self.raw, self.paper) {
            (_, true) => SamplingConfig::paper(),
            (true, _) => SamplingConfig::raw(),
            _ => SamplingConfig::default(),
        };
        let config = SamplingConfig {
            mode,
            cache: self.cache,
            precision: self.precision,
            spawn: self.life,
            lights: self.lights,
            temperature: self.temperature.or(base.temperature),
            top_k: self.top_k.unwrap_or(base.top_k),
            top_p: self.top_p.or(base.top_p),
            decay: self.decay.unwrap_or(base.decay),
            redraws: self.redraws.unwrap_or(base.redraws),
            limits: base.limits && !self.no_limits,
            routes: self.routes,
            ..base
        };
        let absurd = |t: &f64| !(*t > 0.0 && t.is_finite());
        let wrong = if let Some(t) = config.temperature.filter(absurd) {
            format!("--temperature: expected a number above 0, found {t}")
        } else if config.top_k == 0 {
            "--top-k: expected at least 1, found 0".into()
        } else if let Some(p) = config.top_p.filter(|p| !(*p > 0.0 && *p <= 1.0)) {
            format!("--top-p: expected a number above 0 and at most 1, found {p}")
        } else if !(config.decay >= 0.0 && config.decay.is_finite()) {
            format!("--decay: expected 0 or more, found {}", config.decay)
        } else if self.ruled && !config.has_rules() {
            "--ruled: expected a rule, found --redraws 0 and --no-limits".into()
        } else {
            return Ok(config);
        };
        Err(WrongArguments(wrong).into())
    }

    /// The decoding: under rules, unless `--paper` is given.
    ///
    /// Error: as [`Draw::resolve`].
    pub(crate) fn decoding(&self, mode: Mode) -> anyhow::Result<Decoding> {
        let sampling = self.resolve(mode)?;
        Ok(match self.paper {
            true => Decoding::paper(sampling),
            false => Decoding::of(sampling),
        })
    }

    /// Every decoding that a table shows: beside the rules also the network alone, unless the flags
    /// request one decoding.
    ///
    /// Error: as [`Draw::resolve`].
    pub(crate) fn decodings(&self, mode: Mode) -> anyhow::Result<Vec<Decoding>> {
        let one = self.decoding(mode)?;
        let is_alone = self.ruled || !one.sampling.has_rules();
        let raw = (!is_alone).then(|| one.without_rules());
        Ok(std::iter::once(one).chain(raw).collect())
    }

    /// Flags that cannot both be meant, as a sentence.
    fn contradiction(&self) -> Option<String> {
        let ways = [
            ("--raw", self.raw),
            ("--paper", self.paper),
            ("--ruled", self.ruled),
        ];
        let mut ways = ways.iter().filter(|(_, is_requested)| *is_requested);
        let (way, _) = ways.next()?;
        if let Some((other, _)) = ways.next() {
            return Some(format!(
                "{way}: expected one way of decoding, found {other} too"
            ));
        }
        let redraws = self.redraws.map(|n| n.to_string());
        if self.raw {
            return redraws.map(|n| {
                format!(
                    "--raw: expected no --redraws, since the network alone draws nothing again, \
                     found --redraws {n}"
                )
            });
        }
        let given = [
            ("--temperature", self.temperature.map(|x| x.to_string())),
            ("--top-k", self.top_k.map(|n| n.to_string())),
            ("--top-p", self.top_p.map(|x| x.to_string())),
            ("--decay", self.decay.map(|x| x.to_string())),
            ("--redraws", redraws),
        ];
        let mut given = given.into_iter().filter(|_| self.paper);
        given.find_map(|(flag, value)| {
            let value = value?;
            Some(format!(
                "--paper: expected no {flag}, since the paper's decoding sets it, found {flag} {value}"
            ))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::machine;

    fn draw() -> Draw {
        Draw {
            cache: CacheMode::Window,
            precision: Precision::F32,
            temperature: None,
            top_k: None,
            top_p: None,
            decay: None,
            redraws: None,
            no_limits: false,
            routes: Routes::Late,
            raw: false,
            paper: false,
            ruled: false,
            life: false,
            lights: LightSource::Model,
        }
    }

    #[test]
    fn flags_that_no_world_follows_are_refused() {
        let folder = machine::repository().join("datasets/weights");
        let model = |name: &str| WorldName::Model(folder.join(name));
        let relative = model("gump-relative.safetensors");
        let sequence = model("gump-tiny.safetensors");
        let sampling = |draw: Draw| Sampling {
            mode: Mode::PartialAr,
            draw,
        };
        let wrong = |sampling: &Sampling, worlds: &[&WorldName]| {
            let checked = sampling.check(worlds);
            checked.map_or_else(|error| error.to_string(), |()| String::new())
        };
        let raw = sampling(Draw {
            raw: true,
            ..draw()
        });
        let error = wrong(&raw, &[&WorldName::Idm]);
        assert!(
            error.starts_with("--raw: ") && error.contains("found idm"),
            "{error}"
        );
        assert_eq!(wrong(&raw, &[&WorldName::Idm, &relative]), "");
        let decay = sampling(Draw {
            decay: Some(0.5),
            ..draw()
        });
        let error = wrong(&decay, &[&WorldName::Log, &relative]);
        assert!(
            error.starts_with("--decay: ") && error.contains("gump-relative"),
            "{error}"
        );
        assert_eq!(wrong(&decay, &[&relative, &sequence]), "");
        let mode = Sampling {
            mode: Mode::FullAr,
            ..sampling(draw())
        };
        assert!(wrong(&mode, &[&relative]).starts_with("--mode: "));
        let spawn = sampling(Draw {
            life: true,
            ..draw()
        });
        assert_eq!(wrong(&spawn, &[&WorldName::Idm]), "");
    }

    #[test]
    fn stored_settings_are_read_under_former_and_present_names() {
        let config = SamplingConfig {
            spawn: true,
            ..SamplingConfig::default()
        };
        let stored = serde_json::to_string(&config).unwrap();
        assert!(stored.contains("\"life\":true") && stored.contains("\"pace\":"));
        let present = stored
            .replace("\"life\"", "\"spawn\"")
            .replace("\"pace\"", "\"spawn_rates\"");
        for text in [stored, present] {
            assert_eq!(
                serde_json::from_str::<SamplingConfig>(&text).unwrap(),
                config
            );
        }
    }

    #[test]
    fn flags_choose_the_decodings_of_a_table() {
        let check = |flags: Draw, expected: &[&str]| {
            let found = flags.decodings(Mode::FullAr).unwrap();
            let names: Vec<_> = found.iter().map(|decoding| decoding.name).collect();
            assert_eq!(names, expected);
            assert!(found.iter().all(|d| d.sampling.mode == Mode::FullAr));
            found
        };
        let redraws = Some(0);
        let both = check(draw(), &["ruled", "raw"]);
        assert_eq!(both[0].sampling.clone().without_rules(), both[1].sampling);
        check(
            Draw {
                ruled: true,
                ..draw()
            },
            &["ruled"],
        );
        check(
            Draw {
                raw: true,
                ..draw()
            },
            &["raw"],
        );
        check(Draw { redraws, ..draw() }, &["ruled", "raw"]);
        let no_limits = true;
        let flags = || Draw {
            redraws,
            no_limits,
            ..draw()
        };
        check(flags(), &["raw"]);
        assert!(
            Draw {
                ruled: true,
                ..flags()
            }
            .resolve(Mode::FullAr)
            .is_err()
        );
        let paper = check(
            Draw {
                paper: true,
                ..draw()
            },
            &["paper"],
        );
        let expected = SamplingConfig {
            mode: Mode::FullAr,
            ..SamplingConfig::paper()
        };
        assert_eq!(paper[0].sampling, expected);
        let warm = Draw {
            temperature: Some(0.9),
            ..draw()
        };
        let raw = check(Draw { raw: true, ..warm }, &["raw"]);
        assert_eq!(raw[0].sampling.temperature, Some(0.9));
    }
}
