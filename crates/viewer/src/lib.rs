//! A run in the browser: one page that the program itself serves, and a socket over which it asks for views. Nothing
//! is fetched from elsewhere.

pub mod messages;
mod request;
mod scene;
mod server;
mod session;
mod shared;

pub use server::{Server, ViewerError, ViewerOptions};

/// Whether a request's head is admitted, for fuzzing.
pub fn fuzz_request(head: &[u8]) {
    if let Ok(r) = request::parse(head) {
        let _ = request::admit(&r, &["127.0.0.1:7007".into()], Some("abc"));
    }
}

/// Whether a message of the page makes sense, for fuzzing.
pub fn fuzz_message(text: &[u8]) {
    session::fuzz(text);
}
