//! The sections of a payload as data: each payload lists the name, element and dimensions of its sections once. Layouts, writers,
//! `layout.json` and the arrays in Python derive from that list (decision 21).

/// The type of a value in a section or a record, as other languages read it.
pub trait WireElement {
    /// The scalar as numpy writes it ("<f4", little endian), or the name of a record of `layout.json`.
    const SCALAR: &'static str;

    /// Shape of the value; empty for a scalar.
    #[must_use]
    fn shape() -> Vec<usize> {
        Vec::new()
    }
}

macro_rules! scalars {
    ($($scalar:ty: $name:literal),+ $(,)?) => {
        $(impl WireElement for $scalar {
            const SCALAR: &'static str = $name;
        })+
    };
}

scalars!(u8: "|u1", u16: "<u2", u32: "<u4", u64: "<u8", i32: "<i4", f32: "<f4", f64: "<f8");

impl<T: WireElement, const N: usize> WireElement for [T; N] {
    const SCALAR: &'static str = T::SCALAR;

    fn shape() -> Vec<usize> {
        let mut shape = vec![N];
        shape.extend(T::shape());
        shape
    }
}

/// Scalar and shape of an element for numpy. An array of bytes is text: one opaque value, not numbers.
#[must_use]
pub fn numpy_type<T: WireElement>() -> (String, Vec<usize>) {
    let mut shape = T::shape();
    match (T::SCALAR, shape.pop()) {
        ("|u1", Some(bytes)) => (format!("|V{bytes}"), shape),
        (scalar, last) => {
            shape.extend(last);
            (scalar.to_owned(), shape)
        }
    }
}

/// One section of a payload.
#[derive(Debug, Clone, Copy)]
pub struct SectionSpec {
    /// Its name.
    pub name: &'static str,
    /// Scalar and shape of an element.
    pub element: fn() -> (String, Vec<usize>),
    /// Names of the dimensions whose product is the number of elements.
    pub dimensions: &'static [&'static str],
}

impl SectionSpec {
    /// Shape of the whole section: its dimensions by `size`, then those of an element.
    #[must_use]
    pub fn shape(&self, size: impl Fn(&str) -> usize) -> Vec<usize> {
        let mut shape: Vec<usize> = self.dimensions.iter().map(|dimension| size(dimension)).collect();
        shape.extend((self.element)().1);
        shape
    }
}

/// Declares a payload from the list of its sections: `Layout(dimension, …) { name: Element, [dimension, …]; … }`. With `=> Writer`
/// behind the dimensions it also declares the sections as mutable slices of their elements.
macro_rules! payload_layout {
    (
        $(#[$layout_doc:meta])*
        $layout:ident($($dimension:ident),+) => $writer:ident {
            $($(#[$doc:meta])* $name:ident: $element:ty, [$($of:ident),+];)+
        }
    ) => {
        $crate::section::payload_layout! {
            $(#[$layout_doc])*
            $layout($($dimension),+) {
                $($(#[$doc])* $name: $element, [$($of),+];)+
            }
        }

        #[doc = concat!("The sections of [`", stringify!($layout), "`] as slices of their elements, to be written.")]
        #[derive(Debug)]
        pub struct $writer<'a> {
            $($(#[$doc])* pub $name: &'a mut [$element],)+
        }

        impl<'a> $writer<'a> {
            /// The sections of a payload.
            ///
            /// # Errors
            /// The payload is too short.
            pub fn split(payload: &'a mut [u8], layout: &$layout) -> Result<Self, $crate::block::BlockError> {
                let [$($name),+] = $crate::block::split_mut(payload, &[$(layout.$name),+])?;
                Ok(Self { $($name: bytemuck::cast_slice_mut($name),)+ })
            }
        }
    };
    (
        $(#[$layout_doc:meta])*
        $layout:ident($($dimension:ident),+) {
            $($(#[$doc:meta])* $name:ident: $element:ty, [$($of:ident),+];)+
        }
    ) => {
        $(#[$layout_doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub struct $layout {
            $($(#[$doc])* pub $name: $crate::block::Section,)+
            /// Sizes of the dimensions, as the header carries them.
            pub shape: [u32; $crate::header::DIMENSIONS],
            /// Length of the payload in bytes.
            pub len: usize,
        }

        impl $layout {
            /// Every section, in order.
            pub const SECTIONS: &'static [$crate::section::SectionSpec] = &[$(
                $crate::section::SectionSpec {
                    name: stringify!($name),
                    element: $crate::section::numpy_type::<$element>,
                    dimensions: &[$(stringify!($of)),+],
                },
            )+];

            /// Names of the dimensions, in the order of the header's shape.
            pub const DIMENSIONS: &'static [&'static str] = &[$(stringify!($dimension)),+];

            /// Layout for these dimensions. Lengths that do not fit into a `usize` saturate: no payload holds them.
            #[must_use]
            pub fn sized($($dimension: usize),+) -> Self {
                let mut shape = [0; $crate::header::DIMENSIONS];
                for (place, size) in shape.iter_mut().zip([$($dimension),+]) {
                    *place = u32::try_from(size).unwrap_or(u32::MAX);
                }
                let ([$($name),+], len) = $crate::block::sections([
                    $(size_of::<$element>()$(.saturating_mul($of))+),+
                ]);
                Self { $($name,)+ shape, len }
            }

            /// Layout of the message with this header.
            #[must_use]
            pub fn of(header: &$crate::header::MessageHeader) -> Self {
                let [$($dimension,)+ ..] = header.shape;
                Self::sized($($dimension as usize),+)
            }

            /// Name and place of every section, in order.
            #[must_use]
            pub fn named(&self) -> [(&'static str, $crate::block::Section); Self::SECTIONS.len()] {
                [$((stringify!($name), self.$name)),+]
            }
        }
    };
}
pub(crate) use payload_layout;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{observation::ObservationLayout, world::WorldLayout};

    #[test]
    fn a_section_has_the_length_of_its_shape() {
        let sizes = |dimension: &str| match dimension {
            "slots" => 5,
            "fields" => 9,
            _ => 3,
        };
        let layout = ObservationLayout::sized(5, 9, 3, 3);
        for (spec, (name, section)) in ObservationLayout::SECTIONS.iter().zip(layout.named()) {
            let scalar = match (spec.element)().0.as_str() {
                "<f8" | "<u8" => 8,
                "|u1" => 1,
                _ => 4,
            };
            assert_eq!(spec.name, name);
            assert_eq!(
                spec.shape(sizes).iter().product::<usize>() * scalar,
                section.len,
                "{name}"
            );
        }
    }

    #[test]
    fn text_is_opaque_and_records_go_by_their_name() {
        assert_eq!(numpy_type::<[u8; 64]>(), ("|V64".to_owned(), vec![]));
        assert_eq!(numpy_type::<[[f32; 2]; 4]>(), ("<f4".to_owned(), vec![4, 2]));
        let states = WorldLayout::SECTIONS[0];
        assert_eq!((states.element)(), ("VehicleState".to_owned(), vec![]));
        assert_eq!(states.dimensions, ["bodies"]);
    }
}
