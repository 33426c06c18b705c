//! Proposals, imagining them in any world, choosing one.
