//! Trains the network with relative attention: `train_relative [DATA OUT STEPS WIDTH LAYERS]`.
//!
//! Without arguments it runs a few steps on shipped scenes as a demonstration. If the file of a run
//! exists the run continues; `model:OUT` is then a world for `cargo xtask simulate` and `evaluate`.

use std::path::PathBuf;

use gump::model::relative::RelativeConfig;
use gump::scene::Scenario;
use gump::train::relative::{RelativeTrainConfig, RelativeTrainer};

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let shipped = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../datasets/mini/procedural.tfrecord.gz"
    );
    let data = args.first().map_or(shipped, String::as_str);
    let out = args.get(1).map(PathBuf::from);
    let number = |i: usize, usual: usize| args.get(i).map_or(Ok(usual), |text| text.parse());
    let width = number(3, 64)?;
    let model = RelativeConfig {
        width,
        heads: width / 32,
        layers: number(4, 2)?,
        ..RelativeConfig::default()
    };
    let config = RelativeTrainConfig {
        steps: number(2, 6)?,
        ..RelativeTrainConfig::default()
    };
    let records = gump::data::open(data.as_ref())?;
    let scenarios: Result<Vec<Scenario>, _> = records.map(|r| r.map(|r| r.scenario)).collect();
    let device = gump::model::Device::Cpu;
    let mut trainer = match out.as_ref().filter(|out| out.is_file()) {
        Some(run) => RelativeTrainer::resume(run, scenarios?, &device)?,
        None => RelativeTrainer::new(model, config, scenarios?, &device)?,
    };
    println!("{} parameters", trainer.network().parameters().count());
    let mut nodes = 0;
    while trainer.steps_done() < trainer.config().steps {
        let step = trainer.step()?;
        nodes += step.nodes;
        if step.step.is_multiple_of(50) || step.step == trainer.config().steps {
            let (done, loss) = (step.step, step.loss);
            println!("step {done} loss {loss:.3}, {nodes} agents at frames seen");
        }
        if let Some(out) = out.as_ref().filter(|_| step.step.is_multiple_of(250)) {
            trainer.save(out)?;
        }
    }
    out.map_or(Ok(()), |out| Ok(trainer.save(&out)?))
}
