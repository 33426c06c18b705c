//! Lengths of scenes in tokens, and losses of tokenization, over a whole file.
//!
//! `cargo run -p examples --example tokens_of_a_dataset [FILE]`

use std::path::PathBuf;

use gump::tokenizer::{Field, Identities, Tokenizer, TokenizerConfig, VOCABULARY_SIZE};

const SHIPPED: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../datasets/mini/procedural.tfrecord.gz"
);

fn main() -> anyhow::Result<()> {
    let path = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| SHIPPED.into()));
    let tokenizer = Tokenizer::new(TokenizerConfig::default());
    let (mut lengths, mut clamped, mut far) = (Vec::new(), 0, 0);
    let mut errors: Vec<f64> = Vec::new();
    for record in gump::data::open(&path)? {
        let scenario = record?.scenario;
        let scene = scenario.present();

        // Three frames half a second apart, in the frame of the ego's present pose.
        let frames = scene.strided_history(5, 3);
        let world_from_scene = scene.ego_now().state.pose;
        let ids = Identities::ranked(&frames, scene.ego, world_from_scene);
        let encoded = tokenizer.encode(scene.map, &frames, scene.ego, world_from_scene, &ids);
        lengths.push(encoded.sequence.len());
        clamped += encoded.report.clamped.values().sum::<usize>();
        far += encoded.report.out_of_range;

        // The present frame once more, from its tokens.
        let last = encoded.sequence.frames().last();
        for token in last.into_iter().flat_map(|frame| frame.agents()) {
            let agent = ids.agent(token.key.id).and_then(|id| scene.now().agent(id));
            let decoded = world_from_scene * token.state.pose().position;
            errors.extend(agent.map(|agent| agent.state.pose.position.distance(decoded)));
        }
    }
    lengths.sort_unstable();
    errors.sort_by(f64::total_cmp);
    let (n, step) = (lengths.len(), Field::X.step());
    println!("a vocabulary of {VOCABULARY_SIZE} tokens, positions in steps of {step:.2} m");
    println!("{n} scenes of {} to {} slots", lengths[0], lengths[n - 1]);
    println!("{clamped} values clamped, {far} agents too far away for a token");
    let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
    println!("positions are off by {median:.2} m (median), {worst:.2} m at worst");
    Ok(())
}
