//! What a precision can express.

use gump_kernels::panels::Precision;
use gump_model::ModelError;

/// Checks that a precision can express the numbers of the parameter called `name`.
///
/// # Errors
/// The first number that it cannot express. In f32 there is none.
pub(crate) fn expressible(
    name: &str,
    numbers: &[f32],
    precision: Precision,
) -> Result<(), ModelError> {
    let (form, largest) = match precision {
        Precision::F32 => return Ok(()),
        Precision::Bf16 => ("bfloat16", f32::from(half::bf16::MAX)),
        Precision::Int8 => ("8 bits", f32::MAX),
    };
    let fits = |number: &f32| number.is_finite() && number.abs() <= largest;
    match numbers.iter().find(|number| !fits(number)) {
        None => Ok(()),
        Some(&number) => Err(ModelError::WeightNotFinite {
            name: name.to_owned(),
            number,
            form,
        }),
    }
}
