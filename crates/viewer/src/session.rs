//! One browser's socket: the last view asked for is drawn, meshes are made beside it.

use crate::messages::{Ask, Box6, Layer, Photograph, Tell};
use crate::server::Shared;
use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewLayer, ViewRequest, ViewSource};
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
/// How long the socket is listened to before there is other work.
const GLANCE: Duration = Duration::from_millis(4);
/// How often training is asked how far it is.
const NEWS: Duration = Duration::from_millis(500);
const THUMBNAIL: u32 = 1 << 31;

struct Session<'a> {
    socket: WebSocket<TcpStream>,
    shared: &'a Arc<Shared>,
    /// What other threads have to tell the page.
    tell: Sender<Tell>,
    told: Receiver<Tell>,
    view: Option<(u32, ViewRequest)>,
    exporting: Arc<AtomicBool>,
}

/// Serves a socket until it closes.
pub fn run(stream: TcpStream, shared: &Arc<Shared>) {
    if stream.set_read_timeout(Some(GLANCE)).is_err() {
        return;
    }
    let config = WebSocketConfig::default().max_message_size(Some(LONGEST)).max_frame_size(Some(LONGEST));
    let socket = WebSocket::from_raw_socket(stream, Role::Server, Some(config));
    let (tell, told) = channel();
    let mut s = Session { socket, shared, tell, told, view: None, exporting: Arc::default() };
    // Errors mean that the page is gone or misbehaves: both end the session.
    let _ = s.talk();
    let _ = s.socket.close(None);
}

impl Session<'_> {
    fn talk(&mut self) -> Result<(), Error> {
        self.send(&scene(&*self.shared.source))?;
        let mut news = Instant::now() - NEWS;
        let (mut last, mut foggy) = (None, Vec::new());
        while !self.shared.stop.load(Ordering::Relaxed) {
            self.listen()?;
            while let Ok(t) = self.told.try_recv() {
                self.send(&t)?;
            }
            if news.elapsed() >= NEWS {
                news = Instant::now();
                let s = self.shared.source.status();
                if last != Some(s) {
                    last = Some(s);
                    // JSON has no infinity.
                    let finite = |v: f64| if v.is_finite() { v } else { 0.0 };
                    let (step, seconds, loss, psnr) = (s.step, s.seconds, finite(s.loss), finite(s.psnr));
                    let held_out = s.held_out.filter(|v| v.is_finite());
                    self.send(&Tell::Status { step, seconds, loss, psnr, held_out, rays_per_s: s.rays_per_s, running: s.running })?;
                }
                let fog = self.shared.source.behind_fog();
                if fog != foggy {
                    self.send(&Tell::Fog { frames: fog.iter().map(|f| *f as u32).collect() })?;
                    foggy = fog;
                }
            }
            if let Some((id, request)) = self.view.take() {
                match self.shared.source.view(&request) {
                    Ok(image) => self.picture(id, &image, 85)?,
                    Err(why) => self.fail(why)?,
                }
            }
        }
        Ok(())
    }

    fn send(&mut self, tell: &Tell) -> Result<(), Error> {
        self.socket.send(Message::text(serde_json::to_string(tell).expect("plain values")))
    }

    fn fail(&mut self, why: impl Into<String>) -> Result<(), Error> {
        self.send(&Tell::Failed { why: why.into() })
    }

    /// Takes all messages that have arrived.
    fn listen(&mut self) -> Result<(), Error> {
        loop {
            match self.socket.read() {
                Ok(Message::Text(text)) => match serde_json::from_str(&text) {
                    Ok(ask) => self.hear(ask)?,
                    Err(e) => self.fail(format!("the page sent a message that cannot be read: {e}"))?,
                },
                Ok(Message::Close(_)) => return Err(Error::ConnectionClosed),
                Ok(_) => {}
                Err(Error::Io(e)) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => return Ok(()),
                Err(e) => return Err(e),
            }
        }
    }

    fn hear(&mut self, ask: Ask) -> Result<(), Error> {
        let source = self.shared.source.clone();
        match ask {
            Ask::View { id, width, height, fov_y, pose, layer, clip } => match view_request(width, height, fov_y, &pose, layer, clip) {
                Some(r) => self.view = Some((id, r)),
                None => self.fail("the view asked for makes no sense")?,
            },
            Ask::Pick { x, y, width, height, fov_y, pose, clip } => {
                let inside = (0.0..width as f64).contains(&x) && (0.0..height as f64).contains(&y);
                match view_request(width, height, fov_y, &pose, Layer::Rgb, clip).filter(|_| inside) {
                    Some(r) => self.send(&Tell::Picked { point: source.point(&r, x, y) })?,
                    None => self.fail("the point asked for makes no sense")?,
                }
            }
            Ask::Measured { points, metres } => match measured(points, metres) {
                Err(()) => self.fail("a measured length needs two points that differ, and a length above 0")?,
                Ok(m) => match source.save_measured(m) {
                    Ok(()) => self.send(&Tell::Saved { what: "scale".into(), file: "scale.json".into() })?,
                    Err(e) => self.fail(e)?,
                },
            },
            Ask::Thumbnail { frame } => match source.thumbnail(frame as usize) {
                Ok(image) => self.picture(THUMBNAIL | frame, &image, 75)?,
                Err(e) => self.fail(e)?,
            },
            Ask::Crop { clip } => match corners(clip) {
                Err(()) => self.fail("the crop box is empty")?,
                Ok(c) => match source.save_crop(c) {
                    Ok(()) => self.send(&Tell::Saved { what: "crop box".into(), file: "crop.json".into() })?,
                    Err(e) => self.fail(e)?,
                },
            },
            Ask::Path { json } => match source.save_path(&json) {
                Ok(f) => {
                    self.send(&Tell::Saved { what: "camera path".into(), file: f.display().to_string() })?;
                    if let Ok(mut p) = self.shared.path.lock() {
                        *p = Some(f);
                    }
                }
                Err(e) => self.fail(e)?,
            },
            Ask::OpenPath { json } => match source.open_path(&json) {
                Ok(json) => self.send(&Tell::Path { json })?,
                Err(e) => self.fail(e)?,
            },
            Ask::Export { format, faces, resolution, clip } => match corners(clip) {
                Ok(clip) => self.export(MeshRequest { format, faces: faces as usize, resolution: resolution as usize, clip })?,
                Err(()) => self.fail("the crop box is empty")?,
            },
        }
        Ok(())
    }

    /// Makes a mesh on a thread of its own.
    fn export(&mut self, request: MeshRequest) -> Result<(), Error> {
        if self.exporting.swap(true, Ordering::Relaxed) {
            return self.fail("a mesh is being made already");
        }
        let (shared, tell, busy) = (self.shared.clone(), self.tell.clone(), self.exporting.clone());
        std::thread::spawn(move || {
            let mut last = Instant::now();
            let made = shared.source.export(&request, &mut |what, i, n| {
                if last.elapsed() > Duration::from_millis(200) {
                    last = Instant::now();
                    let _ = tell.send(Tell::Working { what: what.into(), percent: (100 * i / n.max(1)) as u32 });
                }
            });
            busy.store(false, Ordering::Relaxed);
            let _ = tell.send(match made {
                Ok((file, scale)) => {
                    let glb = file.extension().is_some_and(|e| e == "glb");
                    if glb && let Ok(mut m) = shared.mesh.lock() {
                        *m = Some(file.clone());
                    }
                    Tell::Exported { file: file.display().to_string(), glb, scale }
                }
                Err(why) => Tell::Failed { why },
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

fn scene(source: &dyn ViewSource) -> Tell {
    let s = source.scene();
    let photographs = s.frames.into_iter().map(|f| {
        let (r, t, c) = (f.world_from_camera.rotation, f.world_from_camera.translation, f.camera);
        let row = |k: usize| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]];
        let pose = [row(0), row(1), row(2)].concat().try_into().expect("twelve");
        let fov_y = 2.0 * (0.5 * c.height as f64 / c.fy).atan();
        Photograph { name: f.name, pose, fov_y, aspect: c.width as f64 / c.height as f64, held_out: f.held_out }
    });
    let six = |(lo, hi): ([f32; 3], [f32; 3])| [lo[0], lo[1], lo[2], hi[0], hi[1], hi[2]];
    let w = s.world_from_capture;
    let row = |k: usize| [w.scale * w.rotation.x_axis[k], w.scale * w.rotation.y_axis[k], w.scale * w.rotation.z_axis[k], w.translation[k]];
    let rows: [f64; 12] = [row(0), row(1), row(2)].concat().try_into().expect("twelve");
    let world_from_capture = Box::new(rows);
    let (lo, hi) = s.bounds;
    Tell::Scene {
        name: s.name,
        photographs: photographs.collect(),
        focus: s.focus,
        distance: s.distance,
        world_from_capture,
        bounds: [lo[0], lo[1], lo[2], hi[0], hi[1], hi[2]],
        crop: s.crop.map(six),
        measured: s.measured.map(|m| {
            let [[a, b, c], [d, e, f]] = m.points;
            Box::new([a, b, c, d, e, f, m.metres])
        }),
        path: s.path,
    }
}

/// A length that can be one, or none to forget.
fn measured(points: Option<[f64; 6]>, metres: f64) -> Result<Option<MeasuredLength>, ()> {
    let Some([a, b, c, d, e, f]) = points else { return Ok(None) };
    let points = [[a, b, c], [d, e, f]];
    let sound = points[0] != points[1] && points.iter().flatten().all(|v| v.is_finite()) && metres > 0.0 && metres.is_finite();
    if sound { Ok(Some(MeasuredLength { points, metres })) } else { Err(()) }
}

/// Corners of a box that holds something.
fn corners(b: Option<Box6>) -> Result<Option<([f32; 3], [f32; 3])>, ()> {
    match b {
        None => Ok(None),
        Some([a, b, c, d, e, f]) if a < d && b < e && c < f => Ok(Some(([a, b, c], [d, e, f]))),
        Some(_) => Err(()),
    }
}

fn view_request(width: u32, height: u32, fov_y: f64, pose: &[f64; 12], layer: Layer, clip: Option<Box6>) -> Option<ViewRequest> {
    let clip = corners(clip).ok()?;
    if width < 1 || height < 1 || width.checked_mul(height)? > LARGEST || !(0.01..3.1).contains(&fov_y) {
        return None;
    }
    let column = |k: usize| DVec3::new(pose[k], pose[4 + k], pose[8 + k]);
    let world_from_camera = Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) };
    if pose.iter().any(|v| !v.is_finite()) || world_from_camera.rigidity_error() > 1e-3 {
        return None;
    }
    let f = 0.5 * height as f64 / (0.5 * fov_y).tan();
    let camera = Camera { fx: f, fy: f, ..Camera::pinhole(width, height, 1.0) };
    let layer = match layer {
        Layer::Rgb => ViewLayer::Rgb,
        Layer::Depth => ViewLayer::Depth,
        Layer::Normal => ViewLayer::Normal,
        Layer::Opacity => ViewLayer::Opacity,
        Layer::Occupancy => ViewLayer::Occupancy,
    };
    Some(ViewRequest { camera, world_from_camera, layer, clip })
}

/// Reads a message as a session would.
pub fn fuzz(text: &[u8]) {
    if let Ok(Ask::View { width, height, fov_y, pose, layer, clip, .. }) = serde_json::from_slice(text)
        && let Some(r) = view_request(width, height, fov_y, &pose, layer, clip)
    {
        assert!(r.camera.width * r.camera.height <= LARGEST && r.camera.fx.is_finite());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn senseless_views_are_refused() {
        let level = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let ask = |w, h, fov, pose: &[f64; 12], clip| view_request(w, h, fov, pose, Layer::Rgb, clip).is_some();
        assert!(ask(64, 48, 0.8, &level, None));
        assert!(!ask(0, 48, 0.8, &level, None) && !ask(u32::MAX, u32::MAX, 0.8, &level, None) && !ask(64, 48, 4.0, &level, None));
        assert!(!ask(64, 48, f64::NAN, &level, None) && !ask(64, 48, 0.8, &[f64::NAN; 12], None) && !ask(64, 48, 0.8, &[0.0; 12], None));
        assert!(
            !ask(64, 48, 0.8, &level, Some([0.0, 0.0, 0.0, 1.0, -1.0, 1.0]))
                && ask(64, 48, 0.8, &level, Some([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
        );
        assert!(!ask(64, 48, 0.8, &level, Some([f32::NAN; 6])));
    }
}
