//! The viewer: an HTTP server with one web page, and a WebSocket over which the page requests views. The page loads nothing from
//! elsewhere.
//!
//! The server shows any [`ViewSource`](diorama_geom::view_source::ViewSource): a run, a data set, or a picture of your own. A source lists
//! its layers and controls; the page builds its buttons and sliders from these lists. [`messages`] defines the protocol, from which the
//! page's TypeScript types are generated.
//!
//! ```
//! use diorama_geom::view_controls::ViewLayer;
//! use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewRequest, ViewScene, ViewSource, ViewStatus};
//! use diorama_geom::{ImageU8, Similarity};
//! use diorama_viewer::{Server, ViewerOptions};
//! use std::path::PathBuf;
//! use std::sync::Arc;
//! use std::sync::atomic::AtomicBool;
//!
//! /// Colors each pixel by the direction of its ray.
//! struct Sky;
//!
//! impl ViewSource for Sky {
//!     fn scene(&self) -> ViewScene {
//!         ViewScene {
//!             name: "sky".into(),
//!             frames: Vec::new(),
//!             layers: vec![ViewLayer::new("direction", "Direction")],
//!             controls: Vec::new(),
//!             note: String::new(),
//!             is_run: false,
//!             focus: [0.0; 3],
//!             distance: 1.0,
//!             world_from_capture: Similarity::IDENTITY,
//!             bounds: ([-1.0; 3], [1.0; 3]),
//!             crop: None,
//!             measured: None,
//!             path: None,
//!         }
//!     }
//!
//!     fn view(&self, r: &ViewRequest) -> Result<ImageU8, String> {
//!         let (width, height) = (r.camera.width as usize, r.camera.height as usize);
//!         let color = |i: usize| {
//!             let ray = r.camera.direction((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
//!             (r.world_from_camera.rotation * ray).to_array().map(|v| (127.5 * (v + 1.0)) as u8)
//!         };
//!         Ok(ImageU8 { width, height, channels: 3, data: (0..width * height).flat_map(color).collect() })
//!     }
//!
//!     // ... and what else the page may request; this source has none of it.
//! #   fn status(&self) -> ViewStatus { ViewStatus::default() }
//! #   fn point(&self, _: &ViewRequest, _: f64, _: f64) -> Option<[f64; 3]> { None }
//! #   fn thumbnail(&self, _: usize) -> Result<ImageU8, String> { Err("no photographs".into()) }
//! #   fn save_crop(&self, _: Option<([f32; 3], [f32; 3])>) -> Result<(), String> { Err("not saved".into()) }
//! #   fn save_measured(&self, _: Option<MeasuredLength>) -> Result<(), String> { Err("not saved".into()) }
//! #   fn save_path(&self, _: &str) -> Result<PathBuf, String> { Err("not saved".into()) }
//! #   fn open_path(&self, json: &str) -> Result<String, String> { Ok(json.into()) }
//! #   fn export(&self, _: &MeshRequest, _: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64), String> { Err("no mesh".into()) }
//! }
//!
//! let server = Server::bind(&ViewerOptions { port: 0, ..ViewerOptions::default() }, Arc::new(Sky)).expect("a free port");
//! println!("open {}", server.address());
//! let interrupt = AtomicBool::new(true); // set at once, so that this example ends
//! server.run(&interrupt);
//! ```
//!
//! `examples/own_picture.rs` is a complete source with layers, sliders and legends.

pub mod messages;
mod request;
mod scene;
mod server;
mod session;
mod shared;

pub use server::{Server, ViewerError, ViewerOptions};

/// Parses the head of a request and decides whether to answer it, for fuzzing.
pub fn fuzz_request(head: &[u8]) {
    if let Ok(r) = request::parse(head) {
        let _ = request::admit(&r, &["127.0.0.1:7007".into()], Some("abc"));
    }
}

/// Parses a message from the page, for fuzzing.
pub fn fuzz_message(text: &[u8]) {
    session::fuzz(text);
}
