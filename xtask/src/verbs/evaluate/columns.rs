//! Columns of a comparison: worlds and how they decode, a learned one with and without its rules.

use gump_eval::decoding::{DecodedWorld, DecodedWorldName, Decoding};
use gump_eval::worlds::WorldName;

use crate::charts;
use crate::sampling::Sampling;

/// The columns of some worlds.
///
/// Error: sampling flags that do not fit.
pub(super) fn columns(
    worlds: &[WorldName],
    sampling: &Sampling,
) -> anyhow::Result<Vec<DecodedWorld>> {
    let mut columns = Vec::new();
    sampling.check(&worlds.iter().collect::<Vec<_>>())?;
    for world in worlds {
        let decodings = sampling.decodings(world)?.into_iter();
        columns.extend(decodings.map(|decoding| DecodedWorld {
            world: world.clone(),
            decoding,
        }));
    }
    Ok(columns)
}

/// The heading of a column.
pub(super) fn label(name: &DecodedWorldName) -> String {
    let world = charts::legend(&name.world);
    match name.decoding.as_str() {
        Decoding::NONE if world == "log" => "log replayed".into(),
        Decoding::NONE => world,
        decoding => format!("{world} ({decoding})"),
    }
}
