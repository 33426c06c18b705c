//! Progress of long work: a bar on a terminal, a line every few seconds otherwise.

use std::io::IsTerminal as _;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use gump_eval::Monitor;
use indicatif::{ProgressBar, ProgressStyle};

use crate::run::{interrupted, print_error};

/// Time between lines where there is no terminal: seen soon, and a log of an hour stays short.
/// Chosen by hand.
const LINE_EVERY: Duration = Duration::from_secs(5);

/// Progress of one piece of work; may be advanced from many threads.
pub(crate) struct Progress(Form);

enum Form {
    Silent,
    Bar(ProgressBar),
    Lines(Mutex<Lines>),
}

struct Lines {
    what: String,
    unit: &'static str,
    total: u64,
    done: u64,
    began: Instant,
    printed: Instant,
}

impl Progress {
    /// Begins work of `total` units, for instance "frames"; 0 if the number is unknown.
    pub(crate) fn begin(quiet: bool, what: &str, total: u64, unit: &'static str) -> Self {
        Self(if quiet {
            Form::Silent
        } else if std::io::stderr().is_terminal() {
            let template =
                format!("{{msg}} {{bar:30}} {{pos}}/{{len}} {unit}, {{per_sec}}, {{eta}} left");
            let template = if total == 0 {
                format!("{{msg}} {{pos}} {unit}, {{per_sec}}")
            } else {
                template
            };
            let style = ProgressStyle::with_template(&template)
                .expect("the template of the progress bar is well formed");
            let bar = ProgressBar::new(total).with_style(style);
            Form::Bar(bar.with_message(what.to_owned()))
        } else {
            let now = Instant::now();
            Form::Lines(Mutex::new(Lines {
                what: what.to_owned(),
                unit,
                total,
                done: 0,
                began: now,
                printed: now,
            }))
        })
    }

    /// `n` more units are done.
    pub(crate) fn advance(&self, n: u64) {
        match &self.0 {
            Form::Silent => {}
            Form::Bar(bar) => bar.inc(n),
            Form::Lines(lines) => {
                let mut lines = lines
                    .lock()
                    .unwrap_or_else(std::sync::PoisonError::into_inner);
                lines.done += n;
                if lines.printed.elapsed() >= LINE_EVERY {
                    lines.printed = Instant::now();
                    print_error(&lines.text(lines.began.elapsed()));
                }
            }
        }
    }

    /// Changes the message in front of the bar.
    pub(crate) fn message(&self, what: &str) {
        match &self.0 {
            Form::Silent => {}
            Form::Bar(bar) => bar.set_message(what.to_owned()),
            Form::Lines(lines) => {
                let mut lines = lines
                    .lock()
                    .unwrap_or_else(std::sync::PoisonError::into_inner);
                what.clone_into(&mut lines.what);
            }
        }
    }
}

impl Monitor for Progress {
    fn advance(&self, n: u64) {
        self.advance(n);
    }

    fn is_stopped(&self) -> bool {
        interrupted()
    }

    fn part<'a>(&'a self, name: &str, total: u64, unit: &'static str) -> Box<dyn Monitor + 'a> {
        let is_silent = matches!(self.0, Form::Silent);
        Box::new(Self::begin(is_silent, name, total, unit))
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Form::Bar(bar) = &self.0 {
            bar.finish_and_clear();
        }
    }
}

impl Lines {
    fn text(&self, elapsed: Duration) -> String {
        let Self {
            what,
            unit,
            total,
            done,
            ..
        } = self;
        let rate = *done as f64 / elapsed.as_secs_f64().max(1e-9);
        if *total == 0 {
            return format!("{what}: {done} {unit}, {rate:.1}/s");
        }
        let left = total.saturating_sub(*done) as f64 / rate.max(1e-9);
        format!("{what}: {done}/{total} {unit}, {rate:.1}/s, {left:.0} s left")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_tells_rate_and_time_left() {
        let now = Instant::now();
        let lines = Lines {
            what: "imagining".into(),
            unit: "frames",
            total: 100,
            done: 25,
            began: now,
            printed: now,
        };
        assert_eq!(
            lines.text(Duration::from_secs(5)),
            "imagining: 25/100 frames, 5.0/s, 15 s left"
        );
    }
}
