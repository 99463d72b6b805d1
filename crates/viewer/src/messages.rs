//! Messages between the page and the program. They are defined here only; `web/src/messages.ts` is generated from this file.
//!
//! Poses are `world_from_camera` as three rows of four numbers; cameras look along +z with y down. Boxes are the lowest and highest corner
//! in the world.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
/// Lowest and highest corner of a box in the world.
pub type Box6 = [f32; 6];

/// A kind of picture that the program can render of a view.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
pub struct Layer {
    pub id: String,
    pub label: String,
    pub legend: Option<Legend>,
}

/// Legend of a layer. Colors are `#rrggbb`.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Legend {
    Scale { colors: Vec<String>, low: String, high: String, unit: String },
    Classes { classes: Vec<Class> },
}

/// A color and its meaning.
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
    /// Ids of the layers that it changes; empty: all layers.
    pub layers: Vec<String>,
    pub input: Input,
}

/// Kind of a control, and the values that it accepts.
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

/// A view to render.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[cfg_attr(test, derive(ts_rs::TS), derive(Serialize))]
#[serde(deny_unknown_fields)]
pub struct View {
    pub width: u32,
    pub height: u32,
    pub fov_y: f64,
    pub pose: [f64; 12],
    pub layer: String,
    /// Values of controls by id; controls that are left out have their defaults.
    pub values: BTreeMap<String, Value>,
    pub clip: Option<Box6>,
}

/// Messages from the page.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[cfg_attr(test, derive(ts_rs::TS), derive(Serialize))]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum ClientMessage {
    /// Render a view; only the last request counts. The answer is a binary message: `id`, then a JPEG.
    View {
        id: u32,
        view: View,
    },
    /// Find the point of the world that a pixel shows; answered by `Picked`.
    Pick {
        x: f64,
        y: f64,
        view: View,
    },
    /// Save the true length in meters between two points of the world as the scale of meshes; `null` removes it.
    Measured {
        points: Option<[f64; 6]>,
        metres: f64,
    },
    /// Send a photograph's thumbnail. The answer is a binary message: 2³¹ plus the frame's index, then a JPEG.
    Thumbnail {
        frame: u32,
    },
    /// Save the crop box for `render` and `export`.
    Crop {
        clip: Option<Box6>,
    },
    /// Save a camera path: nerfstudio's JSON with cameras in the world. It can then be fetched as `camera_path.json`.
    Path {
        json: String,
    },
    /// Convert a camera path: nerfstudio's JSON as other programs write it; answered by `Path`.
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

/// The camera of a photograph.
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

/// Messages from the program.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(ts_rs::TS))]
#[serde(tag = "kind", rename_all = "snake_case")]
#[allow(clippy::large_enum_variant, reason = "one message at a time")]
pub enum ServerMessage {
    Scene {
        name: String,
        photographs: Vec<Photograph>,
        layers: Vec<Layer>,
        controls: Vec<Control>,
        /// One line about what can be shown and what cannot; may be empty.
        note: String,
        /// Whether boxes, lengths and paths can be saved and meshes exported.
        is_run: bool,
        focus: [f64; 3],
        distance: f64,
        /// Rows of the similarity from the capture's frame to the world.
        world_from_capture: Box<[f64; 12]>,
        bounds: [f64; 6],
        crop: Option<Box6>,
        /// Two points of the world, and the meters between them.
        measured: Option<Box<[f64; 7]>>,
        path: Option<String>,
    },
    /// The answer to `Pick`; null if the pixel shows no surface.
    Picked {
        point: Option<[f64; 3]>,
    },
    Status {
        #[cfg_attr(test, ts(type = "number"))]
        step: u64,
        seconds: f64,
        /// Completed share of the training, 0 to 1.
        progress: f64,
        running: bool,
        figures: Vec<Figure>,
    },
    /// Charts of training so far. Values of later figures follow in `Status`.
    History {
        charts: Vec<Chart>,
    },
    /// Indices of the photographs whose views are behind fog.
    Fog {
        frames: Vec<u32>,
    },
    Working {
        what: String,
        percent: u32,
    },
    /// A mesh was exported; if it is a GLB, it can be fetched as `mesh.glb`.
    Exported {
        file: String,
        glb: bool,
        /// Meters of the mesh per unit of the capture.
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
        /// The id of the view that could not be rendered, if the failure concerns a view.
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
        let types = [Value::decl(&c), View::decl(&c), ClientMessage::decl(&c), Photograph::decl(&c), ServerMessage::decl(&c)];
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
        assert!(serde_json::from_str::<ClientMessage>(r#"{"kind":"thumbnail","frame":3}"#).is_ok());
        for bad in [r#"{"kind":"shell"}"#, r#"{"kind":"thumbnail","frame":-1}"#, r#"{"kind":"thumbnail","frame":1,"path":"/etc"}"#, "[]"] {
            assert!(serde_json::from_str::<ClientMessage>(bad).is_err(), "{bad}");
        }
    }
}
