//! `--shard K/N|auto`.

use gump_eval::EvalError;
use gump_eval::shard::Shard;

/// `K/N`, or `auto` for what the variables of a scheduler say.
pub(crate) fn shard(text: &str) -> Result<Shard, EvalError> {
    match text {
        "auto" => Shard::of_variables(|name| std::env::var(name).ok()),
        _ => text.parse(),
    }
}
