//! The zenoh side: the endpoint, access to it, the keys of a run, what is published on them, and commands from the network.

pub mod access;
pub mod commands;
pub mod endpoint;
pub mod keys;
pub mod loopback;
pub mod publisher;
