//! Number format of the operands of matrix products.
//!
//! What lives here: the choice and its scope. What does not: the products.
//!
//! The code that computes a loss sets the format once ([`Operands::during`]), and every operation
//! built in that scope multiplies in it, forward and backward: an operation keeps the format it was
//! built with. Layers need not know.

use std::cell::Cell;

/// Number format of the operands of matrix products; sums are always f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Operands {
    /// Not rounded.
    #[default]
    F32,
    /// Rounded to bfloat16.
    Bf16,
}

thread_local! {
    static CURRENT: Cell<Operands> = const { Cell::new(Operands::F32) };
}

impl Operands {
    /// The format of operations that the calling thread builds now.
    pub fn current() -> Self {
        CURRENT.get()
    }

    /// Runs `f`, whose operations multiply operands in this format.
    pub fn during<R>(self, f: impl FnOnce() -> R) -> R {
        /// Restores the previous format when dropped, even if `f` panics.
        struct Before(Operands);
        impl Drop for Before {
            fn drop(&mut self) {
                CURRENT.set(self.0);
            }
        }
        let _before = Before(CURRENT.replace(self));
        f()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scopes_nest() {
        assert_eq!(Operands::current(), Operands::F32);
        Operands::Bf16.during(|| {
            assert_eq!(Operands::current(), Operands::Bf16);
            Operands::F32.during(|| assert_eq!(Operands::current(), Operands::F32));
            assert_eq!(Operands::current(), Operands::Bf16);
        });
        assert_eq!(Operands::current(), Operands::F32);
    }
}
