//! A run in the browser: one page that the program itself serves, and a socket over which it asks for views. Nothing
//! is fetched from elsewhere.

pub mod messages;
mod request;
mod server;
mod session;

pub use server::{Server, ViewerError, ViewerOptions};
