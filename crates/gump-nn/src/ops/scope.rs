//! What the operations that a thread builds take from around them.
//!
//! What lives here: setting it for the time of a call. What does not: what it is, which `deferred` and
//! `packed` have.

use std::cell::RefCell;
use std::thread::LocalKey;

/// Runs `f` with `value` in this place of the thread; the former one is put back even if `f` panics.
pub(super) fn within<T, R>(
    place: &'static LocalKey<RefCell<Option<T>>>,
    value: T,
    f: impl FnOnce() -> R,
) -> R {
    struct Before<T: 'static>(&'static LocalKey<RefCell<Option<T>>>, Option<T>);
    impl<T: 'static> Drop for Before<T> {
        fn drop(&mut self) {
            self.0.replace(self.1.take());
        }
    }
    let _before = Before(place, place.replace(Some(value)));
    f()
}

#[cfg(test)]
mod tests {
    use super::*;

    thread_local! {
        static PLACE: RefCell<Option<u8>> = const { RefCell::new(None) };
    }

    #[test]
    fn the_former_value_comes_back_even_after_a_panic() {
        let now = || PLACE.with_borrow(Clone::clone);
        within(&PLACE, 1, || {
            let inner = || within(&PLACE, 2, || assert_eq!(now(), None, "it is 2"));
            assert!(std::panic::catch_unwind(inner).is_err());
            assert_eq!(now(), Some(1));
        });
        assert_eq!(now(), None);
    }
}
