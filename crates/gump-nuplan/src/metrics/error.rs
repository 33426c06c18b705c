//! Why something cannot be scored.

/// Why a drive, a plan or a scoring is of no use.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NuPlanError {
    /// There is nothing to score.
    #[error("the drive has no samples")]
    NoSamples,
    /// There is nothing to compare with.
    #[error("the drive has no states of the expert")]
    NoExpert,
    /// A state is NaN or infinite.
    #[error("{who} has a state that is not a number at index {index}")]
    NotFinite {
        /// Whose state it is.
        who: &'static str,
        /// Index into its states.
        index: usize,
    },
    /// Times do not increase.
    #[error("the times of {who} do not increase at index {index}")]
    TimeOrder {
        /// Whose times they are.
        who: &'static str,
        /// Index of the later state.
        index: usize,
    },
    /// The expert does not reach far enough.
    #[error("the expert has {found} states a second apart, expected {expected}")]
    ShortExpert {
        /// States needed.
        expected: usize,
        /// States there are.
        found: usize,
    },
    /// A plan is empty, too short, or begins after it was made.
    #[error("the plan of sample {sample} covers {covered} of {needed} comparisons")]
    ShortPlan {
        /// Index of the sample.
        sample: usize,
        /// Comparisons it covers.
        covered: usize,
        /// Comparisons asked for.
        needed: usize,
    },
    /// A scoring is malformed.
    #[error("cannot read the scoring: {what}")]
    Scoring {
        /// What was found, and what was expected.
        what: String,
    },
}
