//! The parts of the network, and a few steps of training.

use gump_eval::datasets::{self, Split};
use gump_model::{Device, checkpoint};
use gump_train::{TrainConfig, Trainer};
use gump_viz::{Chart, Series};
use serde_json::{Value, json};

use super::Demo;
use crate::run::{Run, stop_if_interrupted};
use crate::shipped;

/// Steps a new network takes: enough to see the loss fall, few enough for a demo.
const STEPS: usize = 16;
/// Samples per step: few, for the same reason.
const BATCH: usize = 2;
/// Scenarios the loss is measured on, none of them trained on; few, for the same reason.
const VALIDATED: usize = 4;

/// Parts of the network by the names of their parameters.
const PARTS: [(&str, &str); 4] = [
    (
        "mct",
        "transformer: embeddings, self-attention, attention to the map",
    ),
    ("decoder", "decoder: from a hidden vector to a state"),
    ("visual", "visual encoder and reconstruction"),
    ("trajectory", "trajectory head"),
];

pub(super) fn network(demo: &mut Demo, _: &mut Run) -> anyhow::Result<Value> {
    let network = checkpoint::load(&shipped::weights(), &Device::Cpu)?;
    let config = network.config();
    let parameters = network.parameters();
    let rows: Vec<_> = PARTS
        .iter()
        .map(|(prefix, what)| {
            let n = parameters.count_under(prefix);
            vec![(*what).to_owned(), n.to_string()]
        })
        .collect();
    demo.page
        .section("The network")
        .prose(&format!(
            "{} parameters: {} blocks of width {} with {} heads, a context of {} tokens.",
            parameters.count(),
            config.layers,
            config.width,
            config.heads,
            config.block_size,
        ))
        .table(&["part", "parameters"], &rows);
    Ok(json!({ "parameters": parameters.count(), "weights": shipped::weights() }))
}

pub(super) fn train(demo: &mut Demo, run: &mut Run) -> anyhow::Result<Value> {
    let progress = run.progress("training", STEPS as u64, "steps");
    let read = |split| -> anyhow::Result<_> {
        let parts = datasets::parts(&shipped::data(), split)?;
        Ok(datasets::read(&parts, &progress)?)
    };
    let (scenarios, validation) = (read(Split::Train)?, read(Split::Tune)?);
    drop(progress);
    let shipped = checkpoint::load(&shipped::weights(), &Device::Cpu)?;
    let model = shipped.config().clone();
    let mut config = TrainConfig {
        steps: STEPS,
        batch: BATCH,
        seed: run.seed().0,
        ..TrainConfig::default()
    };
    config.optimizer.learning_rate = 2e-3;
    config.optimizer.warmup = 4;
    let of_shipped = Trainer::continuing(shipped, config.clone(), scenarios.clone())?
        .validate(&validation, VALIDATED)?
        .total;
    let mut trainer = Trainer::new(model, config, scenarios, &Device::Cpu)?;
    let before = trainer.validate(&validation, VALIDATED)?.total;
    let mut curve = Series {
        name: "loss".into(),
        ..Series::default()
    };
    let progress = run.progress("training", STEPS as u64, "steps");
    while trainer.steps_done() < STEPS {
        stop_if_interrupted()?;
        let report = trainer.step()?;
        progress.advance(1);
        curve.points.push((report.step as f64, report.loss.total));
    }
    drop(progress);
    let after = trainer.validate(&validation, VALIDATED)?.total;
    let level = |name: &str, loss: f64| Series {
        name: name.into(),
        points: vec![(1.0, loss), (STEPS as f64, loss)],
        ..Series::default()
    };
    let chart = Chart {
        x_label: "step".into(),
        y_label: "loss, nats".into(),
        series: vec![
            curve,
            level("untrained, on other scenes", before),
            level("shipped, on other scenes", of_shipped),
        ],
        ..Chart::default()
    };
    let caption = "Loss on the samples of each step; the lines are the losses of the untrained and of \
                   the shipped network on scenes that neither was trained on.";
    demo.page
        .section("Learning")
        .prose(&format!(
            "A new network of the shipped one's shape takes {STEPS} steps of {BATCH} samples. On \
             scenes that it is not trained on, its loss falls from {before:.1} to {after:.1} nats; \
             the shipped one, after hours, has {of_shipped:.1}."
        ))
        .chart(&chart, caption)?;
    Ok(
        json!({ "steps": STEPS, "loss_before": before, "loss_after": after, "loss_shipped": of_shipped }),
    )
}
