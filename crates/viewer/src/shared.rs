//! State that all connections of a server share.

use diorama_geom::view_source::ViewSource;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::sync::{Arc, Mutex};

/// State shared by the server and its sessions.
pub struct Shared {
    /// Accepted values of the Host header.
    pub hosts: Vec<String>,
    /// Token in the address; required if other machines can reach the server.
    pub token: Option<String>,
    pub source: Arc<dyn ViewSource>,
    /// The last exported mesh, if it is a GLB.
    pub mesh: Mutex<Option<PathBuf>>,
    /// The last camera path saved.
    pub path: Mutex<Option<PathBuf>>,
    /// Ends all sessions.
    pub stop: AtomicBool,
    /// Number of open connections.
    pub open: AtomicUsize,
}

impl Shared {
    /// State of a server without connections.
    pub fn new(hosts: Vec<String>, token: Option<String>, source: Arc<dyn ViewSource>) -> Shared {
        let (mesh, path) = (Mutex::new(None), Mutex::new(None));
        Shared { hosts, token, source, mesh, path, stop: AtomicBool::new(false), open: AtomicUsize::new(0) }
    }
}
