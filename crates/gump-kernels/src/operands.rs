//! In which form numbers enter matrix products.
//!
//! What lives here: the choice and its scope. What does not: the products.
//!
//! Whoever computes a loss says once in which form ([`Operands::during`]), and every operation that
//! is built in that scope multiplies so, forward and backward: an operation keeps the form it was
//! built with. Layers need not know.

use std::cell::Cell;

/// In which form numbers enter matrix products; sums are always f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Operands {
    /// As they are.
    #[default]
    F32,
    /// Rounded to bfloat16.
    Bf16,
}

thread_local! {
    static CURRENT: Cell<Operands> = const { Cell::new(Operands::F32) };
}

impl Operands {
    /// What operations that the calling thread builds now multiply.
    pub fn current() -> Self {
        CURRENT.get()
    }

    /// Runs `f`, whose operations multiply operands of this form.
    pub fn during<R>(self, f: impl FnOnce() -> R) -> R {
        /// Restores what was before, however `f` ends.
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
