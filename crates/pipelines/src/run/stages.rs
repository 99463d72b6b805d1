//! Stages of work that does many things one after the other.

use diorama_engine::train::Event;

/// Receivers of progress: the name of a stage that begins, the share of it that is done, events of training.
pub struct Listeners<'a> {
    pub stage: &'a mut dyn FnMut(&str),
    pub share: &'a mut dyn FnMut(f64),
    pub events: &'a mut dyn FnMut(&Event),
}
