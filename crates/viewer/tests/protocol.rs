//! Tests the socket as the page uses it, with a source that has its own layers and controls.

#[allow(dead_code)]
#[path = "../examples/own_picture.rs"]
mod own_picture;

use diorama_geom::ImageU8;
use diorama_geom::view_source::{MeasuredLength, MeshRequest, ViewChart, ViewFigure, ViewLine};
use diorama_geom::view_source::{ViewRequest, ViewScene, ViewSource, ViewStatus};
use diorama_viewer::{Server, ViewerOptions};
use own_picture::Ball;
use serde_json::{Value, json};
use std::net::TcpStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tungstenite::{Message, WebSocket};

/// The ball of the example as something that learns, with figures that no other source has.
struct Learning(AtomicBool);

impl ViewSource for Learning {
    fn scene(&self) -> ViewScene {
        Ball.scene()
    }
    fn status(&self) -> ViewStatus {
        let figure = |id: &str, value: f64| ViewFigure { id: id.into(), label: id.to_uppercase(), value, text: format!("{value} %") };
        let mut figures = vec![figure("accuracy", 71.0)];
        figures.extend(self.0.load(Ordering::Relaxed).then(|| figure("val_accuracy", 64.0)));
        ViewStatus { step: 3, running: true, figures, ..ViewStatus::default() }
    }
    fn charts(&self) -> Vec<ViewChart> {
        let lines = self.status().figures.into_iter().map(|f| ViewLine {
            held_out: f.id.starts_with("val_"),
            figure: f.id,
            label: f.label,
            points: vec![(1, 60.0), (3, f.value)],
        });
        vec![ViewChart { label: "Accuracy".into(), unit: "%".into(), lines: lines.collect() }]
    }
    fn view(&self, r: &ViewRequest) -> Result<ImageU8, String> {
        Ball.view(r)
    }
    fn point(&self, _: &ViewRequest, _: f64, _: f64) -> Option<[f64; 3]> {
        None
    }
    fn thumbnail(&self, frame: usize) -> Result<ImageU8, String> {
        Ball.thumbnail(frame)
    }
    fn save_crop(&self, crop: Option<([f32; 3], [f32; 3])>) -> Result<(), String> {
        Ball.save_crop(crop)
    }
    fn save_measured(&self, measured: Option<MeasuredLength>) -> Result<(), String> {
        Ball.save_measured(measured)
    }
    fn save_path(&self, json: &str) -> Result<PathBuf, String> {
        Ball.save_path(json)
    }
    fn open_path(&self, json: &str) -> Result<String, String> {
        Ball.open_path(json)
    }
    fn export(&self, r: &MeshRequest, progress: &mut dyn FnMut(&str, usize, usize)) -> Result<(PathBuf, f64), String> {
        Ball.export(r, progress)
    }
}

struct Page(WebSocket<TcpStream>);

impl Page {
    fn open(address: &str) -> Page {
        let host = address.trim_start_matches("http://").trim_end_matches('/');
        let request = tungstenite::http::Request::builder()
            .uri(format!("ws://{host}/socket"))
            .header("Host", host)
            .header("Origin", format!("http://{host}"))
            .header("Upgrade", "websocket")
            .header("Connection", "Upgrade")
            .header("Sec-WebSocket-Version", "13")
            .header("Sec-WebSocket-Key", tungstenite::handshake::client::generate_key())
            .body(())
            .unwrap();
        Page(tungstenite::client(request, TcpStream::connect(host).unwrap()).unwrap().0)
    }

    /// The next message of the given kind.
    fn next(&mut self, kind: &str) -> Value {
        loop {
            if let Message::Text(t) = self.0.read().unwrap() {
                let v: Value = serde_json::from_str(&t).unwrap();
                if v["kind"] == kind {
                    return v;
                }
            }
        }
    }

    fn request(&mut self, layer: &str, values: Value) {
        // From (0, -4, 0) along +y: x to the right, y down the picture is -z.
        let pose = [1, 0, 0, 0, 0, 0, 1, -4, 0, -1, 0, 0];
        let view = json!({ "width": 64, "height": 64, "fov_y": 0.7, "pose": pose, "layer": layer, "values": values, "clip": null });
        let ask = json!({ "kind": "view", "id": 7, "view": view });
        self.0.send(Message::text(ask.to_string())).unwrap();
    }

    /// Mean color of a view's middle rows.
    fn view(&mut self, layer: &str, values: Value) -> [f64; 3] {
        self.request(layer, values);
        loop {
            match self.0.read().unwrap() {
                Message::Binary(b) => {
                    assert_eq!(b[..4], 7u32.to_le_bytes());
                    let image = image::load_from_memory(&b[4..]).unwrap().to_rgb8();
                    let middle: Vec<_> = image.rows().skip(28).take(8).flatten().collect();
                    return [0, 1, 2].map(|k| middle.iter().map(|p| p[k] as f64).sum::<f64>() / middle.len() as f64);
                }
                Message::Text(t) => assert!(!t.contains("failed"), "{t}"),
                _ => {}
            }
        }
    }
}

fn differ(a: [f64; 3], b: [f64; 3]) -> bool {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f64>() > 6.0
}

#[test]
fn a_source_shows_layers_and_controls_of_its_own() {
    let server = Server::bind(&ViewerOptions { port: 0, ..ViewerOptions::default() }, Arc::new(Ball)).unwrap();
    let (address, end) = (server.address(), Arc::new(AtomicBool::new(false)));
    let serving = std::thread::spawn({
        let end = end.clone();
        move || server.run(&end)
    });
    let mut page = Page::open(&address);

    let scene = page.next("scene");
    let layers: Vec<&str> = scene["layers"].as_array().unwrap().iter().map(|l| l["id"].as_str().unwrap()).collect();
    assert_eq!(layers, ["shaded", "albedo", "height"]);
    assert_eq!(scene["layers"][1]["legend"]["classes"][0], json!({ "label": "warm paint", "color": "#e07a3f" }));
    assert_eq!(scene["layers"][2]["legend"]["unit"], "m");
    let slider = json!({ "kind": "slider", "min": 0.0, "max": 90.0, "step": 1.0, "unit": "°", "default": 40.0 });
    assert_eq!(scene["controls"][0]["input"], slider);
    assert_eq!(scene["controls"][0]["layers"], json!(["shaded"]));
    assert_eq!(scene["controls"][1]["input"]["options"][2], json!({ "id": "checker", "label": "Checker" }));

    let striped = page.view("albedo", json!({}));
    assert!(differ(striped, page.view("shaded", json!({}))), "another layer is another picture");
    assert_eq!(striped, page.view("albedo", json!({ "pattern": "stripes" })), "values that are left out have their defaults");
    assert!(differ(striped, page.view("albedo", json!({ "pattern": "plain" }))), "a pick changes the picture");
    assert_eq!(striped, page.view("albedo", json!({ "sun": 80 })), "albedo does not depend on the sun");
    assert!(differ(page.view("shaded", json!({ "sun": 80 })), page.view("shaded", json!({ "sun": 10 }))), "a slider changes the picture");
    assert!(differ(striped, page.view("albedo", json!({ "sky": true }))), "a toggle changes the picture");

    for (layer, values, why) in [
        ("depth", json!({}), "there is no layer \"depth\""),
        ("albedo", json!({ "moon": 1 }), "there is no control \"moon\""),
        ("shaded", json!({ "sun": 91 }), "control \"sun\" does not take Number(91.0)"),
        ("albedo", json!({ "pattern": "dots" }), "control \"pattern\" does not take Choice(\"dots\")"),
    ] {
        page.request(layer, values);
        let failed = page.next("failed");
        assert_eq!((failed["why"].as_str(), failed["view"].as_u64()), (Some(why), Some(7)));
    }
    end.store(true, Ordering::Relaxed);
    serving.join().unwrap();
}

#[test]
fn a_source_shows_figures_and_charts_of_its_own() {
    let source = Arc::new(Learning(AtomicBool::new(false)));
    let server = Server::bind(&ViewerOptions { port: 0, ..ViewerOptions::default() }, source.clone()).unwrap();
    let (address, end) = (server.address(), Arc::new(AtomicBool::new(false)));
    let serving = std::thread::spawn({
        let end = end.clone();
        move || server.run(&end)
    });
    let mut page = Page::open(&address);
    let training = json!({ "figure": "accuracy", "label": "ACCURACY", "held_out": false, "points": [[1.0, 60.0], [3.0, 71.0]] });
    assert_eq!(page.next("history")["charts"], json!([{ "label": "Accuracy", "unit": "%", "lines": [training] }]));
    let accuracy = json!({ "id": "accuracy", "label": "ACCURACY", "value": 71.0, "text": "71 %" });
    let status = page.next("status");
    assert_eq!((&status["figures"], &status["step"], &status["running"]), (&json!([accuracy]), &json!(3), &json!(true)));
    // A figure that comes later brings its line with it.
    source.0.store(true, Ordering::Relaxed);
    assert_eq!(page.next("history")["charts"][0]["lines"][1]["held_out"], json!(true));
    assert_eq!(page.next("status")["figures"][1]["text"], "64 %");
    end.store(true, Ordering::Relaxed);
    serving.join().unwrap();
}
