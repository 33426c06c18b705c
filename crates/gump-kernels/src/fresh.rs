//! New memory that is written piece by piece.
//!
//! What lives here: [`fresh_pieces`]. A vector that is first filled with zeros and then written goes
//! through memory twice; here a piece is begun just before it is written, while it is in the cache.
#![allow(
    unsafe_code,
    reason = "a vector's room becomes numbers once every piece of it has been begun, which is here"
)]

use std::mem::MaybeUninit;

use rayon::prelude::*;

use crate::gemm::Threads;

/// `len` numbers in new memory, written by `f(piece_index, piece)`. A piece begins as rows of `row`
/// where there is one, which must divide it, else as zeros.
///
/// Panics when `piece` is 0 or no whole number of rows.
pub fn fresh_pieces(
    len: usize,
    piece: usize,
    row: Option<&[f32]>,
    threads: Threads,
    f: impl Fn(usize, &mut [f32]) + Sync,
) -> Vec<f32> {
    assert!(piece > 0, "pieces of at least one number");
    let whole = row.is_none_or(|row| row.is_empty() || piece.is_multiple_of(row.len()));
    assert!(whole, "pieces of whole rows");
    let mut numbers = Vec::with_capacity(len);
    let room = &mut numbers.spare_capacity_mut()[..len];
    let work = |(i, room): (usize, &mut [MaybeUninit<f32>])| f(i, begun(room, row));
    if threads == Threads::Pool && len > piece {
        room.par_chunks_mut(piece).enumerate().for_each(work);
    } else {
        room.chunks_mut(piece).enumerate().for_each(work);
    }
    // SAFETY: the pieces cover the room, and each of them was begun.
    unsafe { numbers.set_len(len) };
    numbers
}

/// The room as numbers, which are zeros or repeat the row.
fn begun<'a>(room: &'a mut [MaybeUninit<f32>], row: Option<&[f32]>) -> &'a mut [f32] {
    match row {
        None => room.fill(MaybeUninit::new(0.0)),
        Some(row) => {
            for room in room.chunks_mut(row.len().max(1)) {
                for (number, from) in room.iter_mut().zip(row) {
                    number.write(*from);
                }
            }
        }
    }
    let whole = row.is_none_or(|row| !row.is_empty() || room.is_empty());
    assert!(whole, "a row of no numbers begins none");
    // SAFETY: every number has just been written.
    unsafe { &mut *(std::ptr::from_mut(room) as *mut [f32]) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_written_in_place() {
        for threads in [Threads::One, Threads::Pool] {
            let squares = fresh_pieces(10, 4, None, threads, |i, piece| {
                assert!(piece.iter().all(|number| *number == 0.0));
                for (j, number) in piece.iter_mut().enumerate() {
                    *number = ((4 * i + j) * (4 * i + j)) as f32;
                }
            });
            assert_eq!(squares, [0., 1., 4., 9., 16., 25., 36., 49., 64., 81.]);
            let rows = fresh_pieces(8, 4, Some(&[1.0, 2.0]), threads, |i, piece| {
                piece[0] += i as f32;
            });
            assert_eq!(rows, [1., 2., 1., 2., 2., 2., 1., 2.]);
        }
        assert!(fresh_pieces(0, 4, Some(&[]), Threads::Pool, |_, _| {}).is_empty());
    }

    #[test]
    #[should_panic(expected = "pieces of whole rows")]
    fn a_piece_is_a_whole_number_of_rows() {
        fresh_pieces(6, 3, Some(&[1.0, 2.0]), Threads::One, |_, _| {});
    }

    #[test]
    #[should_panic(expected = "begins none")]
    fn an_empty_row_cannot_begin_numbers() {
        fresh_pieces(1, 1, Some(&[]), Threads::One, |_, _| {});
    }
}
