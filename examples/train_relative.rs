//! Trains the relative network on scenarios: `train_relative OUT STEPS WIDTH LAYERS DATA...`.

use std::path::Path;
use std::time::Instant;

use gump_model::relative::{RelativeConfig, RelativeTrainConfig, RelativeTrainer};
use gump_scene::Scenario;

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [out, steps, width, layers, data @ ..] = args.as_slice() else {
        anyhow::bail!("expected OUT STEPS WIDTH LAYERS DATA...");
    };
    let mut scenarios: Vec<Scenario> = Vec::new();
    for path in data {
        for record in gump_data::open(Path::new(path))? {
            scenarios.push(record?.scenario);
        }
    }
    eprintln!("{} scenarios", scenarios.len());
    let held_out = scenarios.split_off(scenarios.len().saturating_sub(24));
    let width: usize = width.parse()?;
    let model = RelativeConfig {
        width,
        heads: width / 32,
        layers: layers.parse()?,
        ..RelativeConfig::default()
    };
    let config = RelativeTrainConfig {
        steps: steps.parse()?,
        ..RelativeTrainConfig::default()
    };
    let out = Path::new(out);
    let device = gump_model::Device::Cpu;
    let mut trainer = match out.is_file() {
        true => RelativeTrainer::resume(out, scenarios, &device)?,
        false => RelativeTrainer::new(model, config, scenarios, &device)?,
    };
    eprintln!("{} parameters", trainer.network().parameters().count());
    let began = Instant::now();
    let (mut nodes, mut fields) = (0, [0.0; 4]);
    while trainer.steps_done() < trainer.config().steps {
        let report = trainer.step()?;
        nodes += report.nodes;
        fields.iter_mut().zip(report.fields).for_each(|(a, b)| *a += b / 50.0);
        if report.step % 50 == 0 {
            let rate = nodes as f64 / began.elapsed().as_secs_f64();
            eprintln!("{} {:?} sum {:.3} norm {:.2} {rate:.0} nodes/s", report.step, fields.map(|f: f64| (f * 1e3).round() / 1e3), fields.iter().sum::<f64>(), report.gradient_norm);
            fields = [0.0; 4];
        }
        if report.step % 500 == 0 {
            let held = trainer.validate(&held_out)?;
            eprintln!("  held out {held:?} sum {:.3}", held.iter().sum::<f64>());
            trainer.save(out)?;
        }
    }
    trainer.save(out)?;
    Ok(())
}
