//! `--shard K/N|auto`.

use gump_eval::shard::Shard;

/// `K/N`, or `auto` for what the variables of a scheduler say.
pub(crate) fn shard(text: &str) -> Result<Shard, String> {
    let shard = match text {
        "auto" => Shard::of_variables(|name| std::env::var(name).ok()),
        _ => text.parse(),
    };
    shard.map_err(|error| error.to_string())
}
