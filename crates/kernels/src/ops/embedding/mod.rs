//! Look-up of table rows by index, and the gradient of the table.

pub mod cpu;
pub mod reference;
#[cfg(test)]
mod tests;
