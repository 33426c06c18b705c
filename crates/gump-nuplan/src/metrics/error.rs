//! Errors of metrics and scores.

/// Why a drive or plan cannot be scored.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum NuPlanError {
    /// There are no samples.
    #[error("the drive has no samples")]
    NoSamples,
    /// There is no expert to compare with.
    #[error("the drive has no states of the expert")]
    NoExpert,
    /// A state is NaN or infinite.
    #[error("{who} has a state that is not a number at index {index}")]
    NotFinite {
        /// Name of the series that the state belongs to.
        who: &'static str,
        /// Index into the states of the series.
        index: usize,
    },
    /// Times do not increase.
    #[error("the times of {who} do not increase at index {index}")]
    TimeOrder {
        /// Name of the series that the times belong to.
        who: &'static str,
        /// Index of the later state.
        index: usize,
    },
    /// The expert's states end too early.
    #[error("the expert has {found} states a second apart, expected {expected}")]
    ShortExpert {
        /// States needed.
        expected: usize,
        /// States present.
        found: usize,
    },
    /// A plan is empty, too short, or starts after its sample.
    #[error("the plan of sample {sample} covers {covered} of {needed} comparisons")]
    ShortPlan {
        /// Index of the sample.
        sample: usize,
        /// Comparisons possible.
        covered: usize,
        /// Comparisons required.
        needed: usize,
    },
    /// An invalid scoring.
    #[error("cannot read the scoring: {what}")]
    Scoring {
        /// The invalid entry, and what was expected.
        what: String,
    },
}
