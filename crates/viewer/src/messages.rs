//! What page and program say to each other, defined here alone: `web/src/messages.ts` is made from this file.
//!
//! Poses are `world_from_camera` as three rows of four; cameras look along +z with y down. Boxes are lowest and highest corner
//! in the world.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

pub type Box6 = [f32; 6];

/// A picture that the program can draw of a view.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Layer {
    pub id: String,
    pub label: String,
    pub legend: Option<Legend>,
}

/// What the colors of a layer stand for. Colors are `#rrggbb`.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Legend {
    Scale { colors: Vec<String>, low: String, high: String, unit: String },
    Classes { classes: Vec<Class> },
}

/// A color and what it stands for.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Class {
    pub label: String,
    pub color: String,
}

/// A setting of the views.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Control {
    pub id: String,
    pub label: String,
    pub help: String,
    /// Layers that it changes; empty: all.
    pub layers: Vec<String>,
    pub input: Input,
}

/// What a control takes.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Input {
    Slider { min: f64, max: f64, step: f64, unit: String, default: f64 },
    Toggle { default: bool },
    Pick { options: Vec<Choice>, default: String },
}

/// One option of a pick.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Choice {
    pub id: String,
    pub label: String,
}

/// The value of a control.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[cfg_attr(test, derive(ts_rs::TS), derive(Serialize))]
#[serde(untagged)]
pub enum Value {
    Number(f64),
    Switch(bool),
    Choice(String),
}

/// What the camera sees.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[cfg_attr(test, derive(ts_rs::TS), derive(Serialize))]
#[serde(deny_unknown_fields)]
pub struct View {
    pub width: u32,
    pub height: u32,
    pub fov_y: f64,
    pub pose: [f64; 12],
    pub layer: String,
    /// Values of controls by their ids; those that are left out have their defaults.
    pub values: BTreeMap<String, Value>,
    pub clip: Option<Box6>,
}

/// From the page.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[cfg_attr(test, derive(ts_rs::TS), derive(Serialize))]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Ask {
    /// Draw a view; only the last one asked for counts. It is answered by a binary message: `id`, then a JPEG.
    View {
        id: u32,
        view: View,
    },
    /// Which point of the world a pixel shows; answered by `Picked`.
    Pick {
        x: f64,
        y: f64,
        view: View,
    },
    /// Keep the true length in metres between two points of the world as the scale of meshes.
    Measured {
        points: Option<[f64; 6]>,
        metres: f64,
    },
    /// Answered by a binary message: 2³¹ plus the frame's number, then a JPEG.
    Thumbnail {
        frame: u32,
    },
    /// Keep the crop box for `render` and `export`.
    Crop {
        clip: Option<Box6>,
    },
    /// Keep a camera path, nerfstudio's JSON with cameras in the world; it can then be fetched as `camera_path.json`.
    Path {
        json: String,
    },
    /// Take over a camera path, nerfstudio's JSON as other programs write it; answered by `Path`.
    OpenPath {
        json: String,
    },
    Export {
        format: String,
        faces: u32,
        resolution: u32,
        clip: Option<Box6>,
    },
}

/// A camera that took a photograph.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Photograph {
    pub name: String,
    pub pose: [f64; 12],
    pub fov_y: f64,
    pub aspect: f64,
    pub held_out: bool,
}

/// A figure of training; `text` is its value with the unit.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Figure {
    pub id: String,
    pub label: String,
    pub value: f64,
    pub text: String,
}

/// Figures over the steps of training, on common axes.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Chart {
    pub label: String,
    pub unit: String,
    pub lines: Vec<Line>,
}

/// Values of a figure: steps and values, oldest first.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Line {
    /// Id of the figure.
    pub figure: String,
    pub label: String,
    /// Of data that was held out: few values, each shown as a dot.
    pub held_out: bool,
    pub points: Vec<(f64, f64)>,
}

/// From the program.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
#[serde(tag = "kind", rename_all = "snake_case")]
#[allow(clippy::large_enum_variant, reason = "one message at a time")]
pub enum Tell {
    Scene {
        name: String,
        photographs: Vec<Photograph>,
        layers: Vec<Layer>,
        controls: Vec<Control>,
        /// One line about what can be seen and what cannot; may be empty.
        note: String,
        /// Whether boxes, lengths and paths can be kept and meshes made.
        is_run: bool,
        focus: [f64; 3],
        distance: f64,
        /// Rows of the similarity that takes meshes to the world.
        world_from_capture: Box<[f64; 12]>,
        bounds: [f64; 6],
        crop: Option<Box6>,
        /// Two points of the world, and the metres between them.
        measured: Option<Box<[f64; 7]>>,
        path: Option<String>,
    },
    /// None where nothing is.
    Picked {
        point: Option<[f64; 3]>,
    },
    Status {
        #[cfg_attr(test, ts(type = "number"))]
        step: u64,
        seconds: f64,
        /// 0 to 1.
        progress: f64,
        running: bool,
        figures: Vec<Figure>,
    },
    /// Charts of training so far. Values of later figures follow in `Status`.
    History {
        charts: Vec<Chart>,
    },
    /// Photographs, by their number, that the field shows through fog.
    Fog {
        frames: Vec<u32>,
    },
    Working {
        what: String,
        percent: u32,
    },
    /// A mesh was made; `mesh.glb` can be fetched where it was a GLB.
    Exported {
        file: String,
        glb: bool,
        /// Metres of the mesh per unit of the capture.
        scale: f64,
    },
    /// A camera path with cameras in the world.
    Path {
        json: String,
    },
    Saved {
        what: String,
        file: String,
    },
    Failed {
        why: String,
        /// The view that was not drawn, where it was one.
        view: Option<u32>,
    },
}

#[cfg(test)]
mod tests {
    use super::*;
    use ts_rs::{Config, TS};

    /// `DIORAMA_BLESS=1` writes the file anew.
    #[test]
    fn the_pages_types_are_those_of_this_file() {
        let c = Config::default();
        let of_views = [Layer::decl(&c), Legend::decl(&c), Class::decl(&c), Control::decl(&c), Input::decl(&c), Choice::decl(&c)];
        let of_training = [Figure::decl(&c), Line::decl(&c), Chart::decl(&c)];
        let types = [Value::decl(&c), View::decl(&c), Ask::decl(&c), Photograph::decl(&c), Tell::decl(&c)];
        let types = of_views.into_iter().chain(of_training).chain(types);
        let text: String = types.map(|t| format!("export {t}\n")).collect();
        let text = format!("// Made from crates/viewer/src/messages.rs by its test; do not edit.\n\n{text}");
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("web/src/messages.ts");
        if std::env::var_os("DIORAMA_BLESS").is_some() {
            std::fs::write(&file, &text).unwrap();
        }
        assert_eq!(std::fs::read_to_string(&file).unwrap_or_default(), text, "run DIORAMA_BLESS=1 cargo test -p diorama-viewer");
    }

    #[test]
    fn unknown_kinds_and_fields_are_errors() {
        assert!(serde_json::from_str::<Ask>(r#"{"kind":"thumbnail","frame":3}"#).is_ok());
        for bad in [r#"{"kind":"shell"}"#, r#"{"kind":"thumbnail","frame":-1}"#, r#"{"kind":"thumbnail","frame":1,"path":"/etc"}"#, "[]"] {
            assert!(serde_json::from_str::<Ask>(bad).is_err(), "{bad}");
        }
    }
}
