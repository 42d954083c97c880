//! Several arrays in one payload: sections that each start on a 64-byte boundary.

use bytemuck::Pod;

/// Alignment of every payload and of every section in it, bytes (one cache line, one AVX-512 register).
pub const ALIGNMENT: usize = 64;

/// A byte range within a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Section {
    /// First byte.
    pub offset: usize,
    /// Length in bytes.
    pub len: usize,
}

/// Places sections of the given byte lengths one after the other; returns them with the total length.
#[must_use]
pub fn sections<const N: usize>(lengths: [usize; N]) -> ([Section; N], usize) {
    let mut offset = 0;
    let placed = lengths.map(|len| {
        let section = Section { offset, len };
        // Sizes may come from a header that lies: they saturate, and the payload turns out to be too short.
        let end = offset.saturating_add(len);
        offset = end.checked_next_multiple_of(ALIGNMENT).unwrap_or(usize::MAX);
        section
    });
    (placed, offset)
}

/// A payload is too short or misaligned for a section.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("payload of {actual} bytes does not hold bytes {offset}..{} as whole elements of {element} bytes", offset.saturating_add(*len))]
pub struct BlockError {
    /// Bytes in the payload.
    pub actual: usize,
    /// First byte asked for.
    pub offset: usize,
    /// Bytes asked for.
    pub len: usize,
    /// Size of one element.
    pub element: usize,
}

/// The section as a slice of `T`. An empty section may lie anywhere.
///
/// # Errors
/// The payload is too short, misaligned, or the section is not a whole number of `T`.
pub fn view<T: Pod>(payload: &[u8], section: Section) -> Result<&[T], BlockError> {
    let error = BlockError {
        actual: payload.len(),
        offset: section.offset,
        len: section.len,
        element: size_of::<T>(),
    };
    if section.len == 0 {
        return Ok(&[]);
    }
    let bytes = payload
        .get(section.offset..section.offset.saturating_add(section.len))
        .ok_or(error)?;
    bytemuck::try_cast_slice(bytes).map_err(|_| error)
}

/// The section as a mutable slice of `T`.
///
/// # Errors
/// As [`view`].
pub fn view_mut<T: Pod>(payload: &mut [u8], section: Section) -> Result<&mut [T], BlockError> {
    let error = BlockError {
        actual: payload.len(),
        offset: section.offset,
        len: section.len,
        element: size_of::<T>(),
    };
    let bytes = payload
        .get_mut(section.offset..section.offset.saturating_add(section.len))
        .ok_or(error)?;
    bytemuck::try_cast_slice_mut(bytes).map_err(|_| error)
}

/// Several sections at once as mutable byte slices, in their order in the payload.
///
/// # Errors
/// The payload is too short, or the sections overlap or are out of order.
pub fn split_mut<'a, const N: usize>(
    payload: &'a mut [u8],
    wanted: &[Section; N],
) -> Result<[&'a mut [u8]; N], BlockError> {
    let actual = payload.len();
    let mut rest = payload;
    let mut at = 0;
    let mut parts: [&'a mut [u8]; N] = std::array::from_fn(|_| Default::default());
    for (part, section) in parts.iter_mut().zip(wanted) {
        let error = BlockError {
            actual,
            offset: section.offset,
            len: section.len,
            element: 1,
        };
        let skip = section.offset.checked_sub(at).ok_or(error)?;
        let (_, tail) = std::mem::take(&mut rest).split_at_mut_checked(skip).ok_or(error)?;
        let (head, tail) = tail.split_at_mut_checked(section.len).ok_or(error)?;
        *part = head;
        rest = tail;
        at = section.offset + section.len;
    }
    Ok(parts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn sections_are_aligned_disjoint_and_inside(lengths in prop::array::uniform4(0_usize..10_000)) {
            let (placed, total) = sections(lengths);
            let mut end = 0;
            for (section, len) in placed.iter().zip(lengths) {
                prop_assert_eq!(section.len, len);
                prop_assert_eq!(section.offset % ALIGNMENT, 0);
                prop_assert!(section.offset >= end);
                end = section.offset + section.len;
            }
            prop_assert!(end <= total && total - end < ALIGNMENT);
        }
    }

    #[test]
    fn absurd_lengths_saturate_and_no_payload_holds_them() {
        let (placed, total) = sections([usize::MAX - 3, 8, 0]);
        assert_eq!(total, usize::MAX);
        assert!(view::<u8>(&[0; 64], placed[0]).is_err());
        assert!(view::<u64>(&[0; 64], placed[1]).is_err());
        assert_eq!(view::<u64>(&[0; 64], placed[2]), Ok(&[][..]));
    }

    #[test]
    fn a_short_payload_is_refused() {
        let error = view::<u32>(&[0; 16], Section { offset: 8, len: 16 }).unwrap_err();
        assert_eq!(
            error.to_string(),
            "payload of 16 bytes does not hold bytes 8..24 as whole elements of 4 bytes"
        );
        assert!(
            view::<u32>(
                &[0; 16],
                Section {
                    offset: 0,
                    len: usize::MAX
                }
            )
            .is_err()
        );
    }

    #[test]
    fn split_gives_disjoint_parts_in_order() {
        let (placed, total) = sections([3, 70]);
        let mut payload = vec![0_u8; total];
        let [a, b] = split_mut(&mut payload, &placed).unwrap();
        a.fill(1);
        b.fill(2);
        assert_eq!((payload[2], payload[3], payload[64], payload[133]), (1, 0, 2, 2));
    }
}
