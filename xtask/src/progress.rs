//! Progress of long work: a bar on a terminal, a line every few seconds otherwise.

use std::io::IsTerminal as _;
use std::sync::Mutex;
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use gump_eval::Monitor;
use indicatif::{ProgressBar, ProgressState, ProgressStyle};

use crate::run::{interrupted, print_error};

/// Time between lines where there is no terminal: seen soon, and a log of an hour stays short.
/// Chosen by hand.
const LINE_EVERY: Duration = Duration::from_secs(5);

/// Time between the turns of a spinner. Chosen by eye.
const TICK: Duration = Duration::from_millis(100);

/// Progress of one piece of work; may be advanced from many threads.
pub(crate) struct Progress(Form);

enum Form {
    Silent,
    Bar(ProgressBar),
    Lines(Mutex<Lines>),
    /// A thread prints a line every few seconds until the sender is dropped.
    Told(Option<(Sender<()>, JoinHandle<()>)>),
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).expect("the templates of progress are well formed")
}

/// Units per second, three digits or more.
fn rate(per_second: f64) -> String {
    let digits = match per_second {
        100.0.. => 0,
        1.0.. => 1,
        _ => 2,
    };
    format!("{per_second:.digits$}/s")
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
                format!("{{msg}} {{bar:30}} {{pos}}/{{len}} {unit}, {{rate}}, {{eta}} left");
            let template = if total == 0 {
                format!("{{msg}} {{pos}} {unit}, {{rate}}")
            } else {
                template
            };
            let written = |state: &ProgressState, text: &mut dyn std::fmt::Write| {
                // Nothing to do about a bar that cannot be written.
                let _ = text.write_str(&rate(state.per_sec()));
            };
            let bar =
                ProgressBar::new(total).with_style(style(&template).with_key("rate", written));
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

    /// Begins work whose progress is not known, for instance "writing": seconds pass.
    pub(crate) fn wait(quiet: bool, what: &str) -> Self {
        Self(if quiet {
            Form::Silent
        } else if std::io::stderr().is_terminal() {
            let bar = ProgressBar::new_spinner().with_style(style("{spinner} {msg}, {elapsed}"));
            bar.enable_steady_tick(TICK);
            Form::Bar(bar.with_message(what.to_owned()))
        } else {
            let what = what.to_owned();
            let (done, is_done) = mpsc::channel::<()>();
            let begun = Instant::now();
            let teller = std::thread::spawn(move || {
                while is_done.recv_timeout(LINE_EVERY) == Err(RecvTimeoutError::Timeout) {
                    print_error(&format!("{what}: {:.0} s", begun.elapsed().as_secs_f64()));
                }
            });
            Form::Told(Some((done, teller)))
        })
    }

    /// `n` more units are done.
    pub(crate) fn advance(&self, n: u64) {
        match &self.0 {
            Form::Silent | Form::Told(_) => {}
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
            Form::Silent | Form::Told(_) => {}
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
        match &mut self.0 {
            Form::Bar(bar) => bar.finish_and_clear(),
            Form::Told(told) => {
                if let Some((done, teller)) = told.take() {
                    drop(done);
                    // It only prints, so how it ended does not matter.
                    let _ = teller.join();
                }
            }
            Form::Silent | Form::Lines(_) => {}
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
        let per_second = *done as f64 / elapsed.as_secs_f64().max(1e-9);
        let rate = rate(per_second);
        if *total == 0 {
            return format!("{what}: {done} {unit}, {rate}");
        }
        let left = total.saturating_sub(*done) as f64 / per_second.max(1e-9);
        format!("{what}: {done}/{total} {unit}, {rate}, {left:.0} s left")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_have_no_more_digits_than_they_mean() {
        let rates = [25_770.418_1, 462.8, 12.34, 0.12].map(rate);
        assert_eq!(rates, ["25770/s", "463/s", "12.3/s", "0.12/s"]);
    }

    #[test]
    fn what_is_waited_for_ends() {
        for quiet in [true, false] {
            drop(Progress::wait(quiet, "writing"));
        }
    }

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
