//! Assembles observations: which row belongs to which vehicle, its normalised fields, its history, and the arrays of the message.

pub mod fields;
pub mod history;
pub mod slots;
