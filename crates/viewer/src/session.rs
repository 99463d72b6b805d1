//! One page's socket: renders the last requested view; meshes are exported on another thread.

use crate::messages::{Box6, ClientMessage, ServerMessage, View};
use crate::scene;
use crate::shared::Shared;
use diorama_geom::view_controls::check_lists;
use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewRequest, ViewScene, ViewStatus};
use diorama_geom::{Camera, ImageU8, Pose};
use glam::{DMat3, DVec3};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};
use tungstenite::protocol::{Role, WebSocket, WebSocketConfig};
use tungstenite::{Bytes, Error, Message};

/// Largest message from a page.
const LONGEST: usize = 4 << 20;
/// Largest view, in pixels.
const LARGEST: u32 = 4096 * 2304;
/// Time limit for reading from the socket before other work continues.
const READ_TIMEOUT: Duration = Duration::from_millis(4);
/// Interval of status messages.
const STATUS_INTERVAL: Duration = Duration::from_millis(500);
const THUMBNAIL: u32 = 1 << 31;

struct Session<'a> {
    socket: WebSocket<TcpStream>,
    shared: &'a Arc<Shared>,
    /// The scene that was sent to the page.
    scene: ViewScene,
    /// Messages from other threads to the page.
    outbox: Sender<ServerMessage>,
    inbox: Receiver<ServerMessage>,
    view: Option<(u32, ViewRequest)>,
    exporting: Arc<AtomicBool>,
}

/// Serves a socket until it closes.
pub fn run(stream: TcpStream, shared: &Arc<Shared>) {
    if stream.set_read_timeout(Some(READ_TIMEOUT)).is_err() {
        return;
    }
    let config = WebSocketConfig::default().max_message_size(Some(LONGEST)).max_frame_size(Some(LONGEST));
    let socket = WebSocket::from_raw_socket(stream, Role::Server, Some(config));
    let (outbox, inbox) = channel();
    let mut s = Session { socket, shared, scene: shared.source.scene(), outbox, inbox, view: None, exporting: Arc::default() };
    // Errors mean that the page is closed or misbehaves; both end the session.
    let _ = s.serve();
    let _ = s.socket.close(None);
}

impl Session<'_> {
    fn serve(&mut self) -> Result<(), Error> {
        if let Err(why) = check_lists(&self.scene.layers, &self.scene.controls) {
            return self.fail(why);
        }
        self.send(&scene::message(&self.scene))?;
        let (mut last, mut foggy) = (self.shared.source.status(), Vec::new());
        self.send(&scene::history(&self.shared.source.charts()))?;
        self.send(&scene::status(&last))?;
        let mut last_status = Instant::now() - STATUS_INTERVAL;
        while !self.shared.stop.load(Ordering::Relaxed) {
            self.listen()?;
            while let Ok(t) = self.inbox.try_recv() {
                self.send(&t)?;
            }
            if last_status.elapsed() >= STATUS_INTERVAL {
                last_status = Instant::now();
                let s = self.shared.source.status();
                if last != s {
                    let ids = |s: &ViewStatus| s.figures.iter().map(|f| f.id.clone()).collect::<Vec<_>>();
                    // A new figure has a line of its own in the charts.
                    if ids(&last) != ids(&s) {
                        self.send(&scene::history(&self.shared.source.charts()))?;
                    }
                    self.send(&scene::status(&s))?;
                    last = s;
                }
                let fog = self.shared.source.behind_fog();
                if fog != foggy {
                    self.send(&ServerMessage::Fog { frames: fog.iter().map(|f| *f as u32).collect() })?;
                    foggy = fog;
                }
            }
            if let Some((id, request)) = self.view.take() {
                match self.shared.source.view(&request) {
                    Ok(image) => self.picture(id, &image, 85)?,
                    Err(why) => self.send(&ServerMessage::Failed { why, view: Some(id) })?,
                }
            }
        }
        Ok(())
    }

    fn send(&mut self, message: &ServerMessage) -> Result<(), Error> {
        self.socket.send(Message::text(serde_json::to_string(message).expect("plain values")))
    }

    fn fail(&mut self, why: impl Into<String>) -> Result<(), Error> {
        self.send(&ServerMessage::Failed { why: why.into(), view: None })
    }

    /// Handles all messages that have arrived.
    fn listen(&mut self) -> Result<(), Error> {
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => match serde_json::from_str(&text) {
                    Ok(message) => self.handle(message)?,
                    Err(e) => self.fail(format!("the page sent a message that cannot be read: {e}"))?,
                },
                Ok(Message::Close(_)) => return Err(Error::ConnectionClosed),
                Ok(_) => {}
                Err(Error::Io(e)) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => return Ok(()),
                Err(e) => return Err(e),
            }
        }
    }

    fn handle(&mut self, message: ClientMessage) -> Result<(), Error> {
        let source = self.shared.source.clone();
        match message {
            ClientMessage::View { id, view } => match view_request(&self.scene, view) {
                Ok(r) => self.view = Some((id, r)),
                Err(why) => self.send(&ServerMessage::Failed { why, view: Some(id) })?,
            },
            ClientMessage::Pick { x, y, view } => {
                let inside = (0.0..view.width as f64).contains(&x) && (0.0..view.height as f64).contains(&y);
                match view_request(&self.scene, view) {
                    Ok(r) if inside => self.send(&ServerMessage::Picked { point: source.point(&r, x, y) })?,
                    Ok(_) => self.fail("the requested point lies outside the view")?,
                    Err(why) => self.fail(why)?,
                }
            }
            ClientMessage::Measured { points, metres } => match measured(points, metres) {
                Err(()) => self.fail("a measured length needs two different points and a length above 0")?,
                Ok(m) => match source.save_measured(m) {
                    Ok(()) => self.send(&ServerMessage::Saved { what: "scale".into(), file: "scale.json".into() })?,
                    Err(e) => self.fail(e)?,
                },
            },
            ClientMessage::Thumbnail { frame } => match source.thumbnail(frame as usize) {
                Ok(image) => self.picture(THUMBNAIL | frame, &image, 75)?,
                Err(e) => self.fail(e)?,
            },
            ClientMessage::Crop { clip } => match corners(clip) {
                Err(()) => self.fail("the crop box is empty")?,
                Ok(c) => match source.save_crop(c) {
                    Ok(()) => self.send(&ServerMessage::Saved { what: "crop box".into(), file: "crop.json".into() })?,
                    Err(e) => self.fail(e)?,
                },
            },
            ClientMessage::Path { json } => match source.save_path(&json) {
                Ok(f) => {
                    self.send(&ServerMessage::Saved { what: "camera path".into(), file: f.display().to_string() })?;
                    if let Ok(mut p) = self.shared.path.lock() {
                        *p = Some(f);
                    }
                }
                Err(e) => self.fail(e)?,
            },
            ClientMessage::OpenPath { json } => match source.open_path(&json) {
                Ok(json) => self.send(&ServerMessage::Path { json })?,
                Err(e) => self.fail(e)?,
            },
            ClientMessage::Export { format, faces, resolution, clip } => match corners(clip) {
                Ok(clip) => self.export(MeshRequest { format, faces: faces as usize, resolution: resolution as usize, clip })?,
                Err(()) => self.fail("the crop box is empty")?,
            },
        }
        Ok(())
    }

    /// Exports a mesh on its own thread.
    fn export(&mut self, request: MeshRequest) -> Result<(), Error> {
        if self.exporting.swap(true, Ordering::Relaxed) {
            return self.fail("another mesh is still being exported");
        }
        let (shared, outbox, busy) = (self.shared.clone(), self.outbox.clone(), self.exporting.clone());
        std::thread::spawn(move || {
            let mut last = Instant::now();
            let made = shared.source.export(&request, &mut |what, i, n| {
                if last.elapsed() > Duration::from_millis(200) {
                    last = Instant::now();
                    let _ = outbox.send(ServerMessage::Working { what: what.into(), percent: (100 * i / n.max(1)) as u32 });
                }
            });
            busy.store(false, Ordering::Relaxed);
            let _ = outbox.send(match made {
                Ok((file, scale)) => {
                    let glb = file.extension().is_some_and(|e| e == "glb");
                    if glb && let Ok(mut m) = shared.mesh.lock() {
                        *m = Some(file.clone());
                    }
                    ServerMessage::Exported { file: file.display().to_string(), glb, scale }
                }
                Err(why) => ServerMessage::Failed { why, view: None },
            });
        });
        Ok(())
    }

    fn picture(&mut self, id: u32, image: &ImageU8, quality: u8) -> Result<(), Error> {
        let mut out = id.to_le_bytes().to_vec();
        let kind = if image.channels == 1 { image::ExtendedColorType::L8 } else { image::ExtendedColorType::Rgb8 };
        let made = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, quality).encode(
            &image.data,
            image.width as u32,
            image.height as u32,
            kind,
        );
        match made {
            Ok(()) => self.socket.send(Message::Binary(Bytes::from(out))),
            Err(e) => self.fail(e.to_string()),
        }
    }
}

/// Validates a measured length; `None` removes it.
fn measured(points: Option<[f64; 6]>, metres: f64) -> Result<Option<MeasuredLength>, ()> {
    let Some([a, b, c, d, e, f]) = points else { return Ok(None) };
    let points = [[a, b, c], [d, e, f]];
    let sound = points[0] != points[1] && points.iter().flatten().all(|v| v.is_finite()) && metres > 0.0 && metres.is_finite();
    if sound { Ok(Some(MeasuredLength { points, metres })) } else { Err(()) }
}

/// Corners of a nonempty box.
fn corners(b: Option<Box6>) -> Result<Option<([f32; 3], [f32; 3])>, ()> {
    match b {
        None => Ok(None),
        Some([a, b, c, d, e, f]) if a < d && b < e && c < f => Ok(Some(([a, b, c], [d, e, f]))),
        Some(_) => Err(()),
    }
}

/// Validates a requested view against the scene's layers and controls.
fn view_request(scene: &ViewScene, v: View) -> Result<ViewRequest, String> {
    let senseless = || "the requested view is invalid".to_string();
    let View { width, height, fov_y, pose, layer, values, clip } = v;
    let clip = corners(clip).map_err(|()| "the crop box is empty")?;
    if width < 1 || height < 1 || width.checked_mul(height).ok_or_else(senseless)? > LARGEST || !(0.01..3.1).contains(&fov_y) {
        return Err(senseless());
    }
    let column = |k: usize| DVec3::new(pose[k], pose[4 + k], pose[8 + k]);
    let world_from_camera = Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) };
    if pose.iter().any(|v| !v.is_finite()) || world_from_camera.rigidity_error() > 1e-3 {
        return Err(senseless());
    }
    let f = 0.5 * height as f64 / (0.5 * fov_y).tan();
    let camera = Camera { fx: f, fy: f, ..Camera::pinhole(width, height, 1.0) };
    if !scene.layers.iter().any(|l| l.id == layer) {
        return Err(format!("there is no layer {layer:?}"));
    }
    let values = scene::values(&scene.controls, values)?;
    Ok(ViewRequest { camera, world_from_camera, layer, values, clip })
}

/// Parses a message as a session does.
pub fn fuzz(text: &[u8]) {
    if let Ok(ClientMessage::View { view, .. }) = serde_json::from_slice(text)
        && let Ok(r) = view_request(&scene::with_layer(&view.layer), view)
    {
        assert!(r.camera.width * r.camera.height <= LARGEST && r.camera.fx.is_finite());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::Value;

    const LEVEL: [f64; 12] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

    fn view() -> View {
        View { width: 64, height: 48, fov_y: 0.8, pose: LEVEL, layer: "rgb".into(), values: Default::default(), clip: None }
    }

    #[test]
    fn senseless_views_are_refused() {
        let sound = |v: View| view_request(&scene::with_layer("rgb"), v).is_ok();
        assert!(sound(view()));
        assert!(!sound(View { width: 0, ..view() }) && !sound(View { width: u32::MAX, height: u32::MAX, ..view() }));
        assert!(!sound(View { fov_y: 4.0, ..view() }) && !sound(View { fov_y: f64::NAN, ..view() }));
        assert!(!sound(View { pose: [f64::NAN; 12], ..view() }) && !sound(View { pose: [0.0; 12], ..view() }));
        let clip = |b| View { clip: Some(b), ..view() };
        assert!(sound(clip([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])));
        assert!(!sound(clip([0.0, 0.0, 0.0, 1.0, -1.0, 1.0])) && !sound(clip([f32::NAN; 6])));
    }

    #[test]
    fn layers_and_controls_that_are_not_listed_are_refused() {
        let refusal = |v: View| view_request(&scene::with_layer("rgb"), v).unwrap_err();
        assert_eq!(refusal(View { layer: "albedo".into(), ..view() }), "there is no layer \"albedo\"");
        let values = [("sun".to_string(), Value::Number(1.0))].into();
        assert_eq!(refusal(View { values, ..view() }), "there is no control \"sun\"");
    }
}
