//! The HTTP server: accepts connections, serves the page's files and the socket.

use crate::request::{self, Request};
use crate::session;
use crate::shared::Shared;
use diorama_geom::view_source::ViewSource;
use std::io::Write;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Most connections at a time.
const MOST: usize = 32;
/// Time limit for reading a request and for writing an answer.
const TIME_LIMIT: Duration = Duration::from_secs(10);

const PAGE: &str = include_str!("../web/dist/index.html");
const SCRIPT: &str = include_str!("../web/dist/app.js");
const STYLE: &str = include_str!("../web/dist/app.css");

/// Address to listen on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewerOptions {
    pub host: IpAddr,
    /// 0: any free port.
    pub port: u16,
}

impl Default for ViewerOptions {
    fn default() -> Self {
        ViewerOptions { host: IpAddr::V4(Ipv4Addr::LOCALHOST), port: 7007 }
    }
}

/// Reasons why the viewer cannot start.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    #[error("--port {0}: is in use; choose another, or 0 for any")]
    InUse(u16),
    #[error("--host {0}: cannot listen there: {1}")]
    Listen(SocketAddr, std::io::Error),
}

/// A bound viewer that does not serve yet.
pub struct Server {
    listener: TcpListener,
    shared: Arc<Shared>,
}

impl Server {
    /// Binds the address. Except on the loopback address, a token is required, which is part of [`Server::address`].
    ///
    /// # Errors
    /// If the port is in use or the address does not belong to this machine.
    pub fn bind(options: &ViewerOptions, source: Arc<dyn ViewSource>) -> Result<Server, ViewerError> {
        let wanted = SocketAddr::new(options.host, options.port);
        let listener = TcpListener::bind(wanted).map_err(|e| match e.kind() {
            std::io::ErrorKind::AddrInUse => ViewerError::InUse(options.port),
            _ => ViewerError::Listen(wanted, e),
        })?;
        let failed = |e| ViewerError::Listen(wanted, e);
        let at = listener.local_addr().map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let mut hosts = vec![at.to_string()];
        if options.host.is_loopback() {
            hosts.push(format!("localhost:{}", at.port()));
        } else if options.host.is_unspecified() {
            // Any address of this machine is accepted; the token keeps others out.
            hosts.extend(own_addresses().into_iter().map(|ip| SocketAddr::new(ip, at.port()).to_string()));
        }
        let token = (!options.host.is_loopback()).then(random_token);
        let shared = Shared::new(hosts, token, source);
        Ok(Server { listener, shared: Arc::new(shared) })
    }

    /// The address to open in a browser.
    pub fn address(&self) -> String {
        let host = self.shared.hosts.last().filter(|_| self.shared.token.is_some()).unwrap_or(&self.shared.hosts[0]);
        match &self.shared.token {
            Some(t) => format!("http://{host}/?token={t}"),
            None => format!("http://{host}/"),
        }
    }

    /// Serves until `interrupt` is set.
    pub fn run(&self, interrupt: &AtomicBool) {
        while !interrupt.load(Ordering::Relaxed) {
            match self.listener.accept() {
                Ok((stream, _)) => {
                    let shared = self.shared.clone();
                    if shared.open.fetch_add(1, Ordering::Relaxed) >= MOST {
                        shared.open.fetch_sub(1, Ordering::Relaxed);
                        continue;
                    }
                    std::thread::spawn(move || {
                        let _ = serve(stream, &shared);
                        shared.open.fetch_sub(1, Ordering::Relaxed);
                    });
                }
                Err(_) => std::thread::sleep(Duration::from_millis(20)),
            }
        }
        self.shared.stop.store(true, Ordering::Relaxed);
    }
}

/// Addresses of this machine: that of its default route, and the loopback addresses.
fn own_addresses() -> Vec<IpAddr> {
    let outward = std::net::UdpSocket::bind("0.0.0.0:0").and_then(|s| {
        // Nothing is sent: connecting a UDP socket only queries the routing table.
        s.connect("192.0.2.1:9")?;
        s.local_addr()
    });
    [Some(IpAddr::V4(Ipv4Addr::LOCALHOST)), outward.ok().map(|a| a.ip())].into_iter().flatten().collect()
}

/// 128 random bits from the system.
fn random_token() -> String {
    let mut bits = [0u8; 16];
    getrandom::fill(&mut bits).expect("the system has random numbers");
    bits.iter().map(|b| format!("{b:02x}")).collect()
}

fn serve(mut stream: TcpStream, shared: &Arc<Shared>) -> std::io::Result<()> {
    stream.set_nonblocking(false)?;
    stream.set_read_timeout(Some(TIME_LIMIT))?;
    stream.set_write_timeout(Some(TIME_LIMIT))?;
    stream.set_nodelay(true)?;
    let admitted = request::read(&mut stream).and_then(|r| {
        request::admit(&r, &shared.hosts, shared.token.as_deref())?;
        Ok(r)
    });
    match admitted {
        Err((status, why)) => answer(&mut stream, status, "text/plain; charset=utf-8", why.as_bytes()),
        Ok(Request { path, socket_key: Some(key), .. }) if path == "/socket" => {
            let accept = tungstenite::handshake::derive_accept_key(key.as_bytes());
            write!(
                stream,
                "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accept}\r\n\r\n"
            )?;
            session::run(stream, shared);
            Ok(())
        }
        Ok(r) => file(&mut stream, &r.path, shared),
    }
}

fn file(stream: &mut TcpStream, path: &str, shared: &Shared) -> std::io::Result<()> {
    match path {
        "/" => answer(stream, 200, "text/html; charset=utf-8", PAGE.as_bytes()),
        "/app.js" => answer(stream, 200, "text/javascript; charset=utf-8", SCRIPT.as_bytes()),
        "/app.css" => answer(stream, 200, "text/css; charset=utf-8", STYLE.as_bytes()),
        "/favicon.ico" => answer(stream, 204, "image/x-icon", b""),
        "/mesh.glb" => made(stream, &shared.mesh, "model/gltf-binary"),
        "/camera_path.json" => made(stream, &shared.path, "application/json"),
        _ => answer(stream, 404, "text/plain; charset=utf-8", b"no such page"),
    }
}

/// Answers with a file that a session wrote.
fn made(stream: &mut TcpStream, file: &Mutex<Option<PathBuf>>, kind: &str) -> std::io::Result<()> {
    let file = file.lock().ok().and_then(|f| f.clone());
    match file.map(std::fs::read) {
        Some(Ok(bytes)) => answer(stream, 200, kind, &bytes),
        _ => answer(stream, 404, "text/plain; charset=utf-8", b"the file does not exist yet"),
    }
}

fn answer(stream: &mut TcpStream, status: u16, kind: &str, body: &[u8]) -> std::io::Result<()> {
    let reason = match status {
        200 => "OK",
        204 => "No Content",
        401 => "Unauthorized",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        _ => "Bad Request",
    };
    write!(
        stream,
        "HTTP/1.1 {status} {reason}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\nCache-Control: no-store\r\n\
         X-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\nReferrer-Policy: no-referrer\r\nCross-Origin-Resource-Policy: same-origin\r\n\
         Content-Security-Policy: default-src 'self'; img-src 'self' blob: data:; connect-src 'self' blob:; frame-ancestors 'none'\r\n\r\n",
        body.len()
    )?;
    stream.write_all(body)?;
    stream.flush()
}
