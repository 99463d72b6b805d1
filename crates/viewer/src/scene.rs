//! Converts a source's scene, controls and history to and from messages.

use crate::messages::{Choice, Class, Control, Input, Layer, Legend, Photograph, ServerMessage, Value};
use diorama_geom::view_controls::{self as geom, ControlInput, ControlValue, ControlValues, ViewControl, ViewLayer};
use diorama_geom::view_source::{ViewPoint, ViewScene};
use std::collections::BTreeMap;

/// Approximate number of training values in a curve sent to the page.
const MOST_POINTS: usize = 400;

/// The message that describes a scene.
pub fn message(s: &ViewScene) -> ServerMessage {
    let photographs = s.frames.iter().map(|f| {
        let (r, t, c) = (f.world_from_camera.rotation, f.world_from_camera.translation, f.camera);
        let row = |k: usize| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]];
        let pose = [row(0), row(1), row(2)].concat().try_into().expect("twelve");
        let fov_y = 2.0 * (0.5 * c.height as f64 / c.fy).atan();
        Photograph { name: f.name.clone(), pose, fov_y, aspect: c.width as f64 / c.height as f64, held_out: f.held_out }
    });
    let six = |(lo, hi): ([f32; 3], [f32; 3])| [lo[0], lo[1], lo[2], hi[0], hi[1], hi[2]];
    let w = s.world_from_capture;
    let row = |k: usize| [w.scale * w.rotation.x_axis[k], w.scale * w.rotation.y_axis[k], w.scale * w.rotation.z_axis[k], w.translation[k]];
    let rows: [f64; 12] = [row(0), row(1), row(2)].concat().try_into().expect("twelve");
    let world_from_capture = Box::new(rows);
    let (lo, hi) = s.bounds;
    ServerMessage::Scene {
        name: s.name.clone(),
        photographs: photographs.collect(),
        layers: s.layers.iter().map(layer).collect(),
        controls: s.controls.iter().map(control).collect(),
        note: s.note.clone(),
        is_run: s.is_run,
        focus: s.focus,
        distance: s.distance,
        world_from_capture,
        bounds: [lo[0], lo[1], lo[2], hi[0], hi[1], hi[2]],
        crop: s.crop.map(six),
        measured: s.measured.map(|m| {
            let [[a, b, c], [d, e, f]] = m.points;
            Box::new([a, b, c, d, e, f, m.metres])
        }),
        path: s.path.clone(),
    }
}

fn layer(l: &ViewLayer) -> Layer {
    let hex = |[r, g, b]: &[u8; 3]| format!("#{r:02x}{g:02x}{b:02x}");
    let legend = l.legend.as_ref().map(|legend| match legend {
        geom::Legend::Scale { colors, low, high, unit } => {
            Legend::Scale { colors: colors.iter().map(hex).collect(), low: low.clone(), high: high.clone(), unit: unit.clone() }
        }
        geom::Legend::Classes(c) => {
            Legend::Classes { classes: c.iter().map(|(label, color)| Class { label: label.clone(), color: hex(color) }).collect() }
        }
    });
    Layer { id: l.id.clone(), label: l.label.clone(), legend }
}

fn control(c: &ViewControl) -> Control {
    let input = match &c.input {
        &ControlInput::Slider { min, max, step, ref unit, default } => Input::Slider { min, max, step, unit: unit.clone(), default },
        &ControlInput::Toggle { default } => Input::Toggle { default },
        ControlInput::Pick { options, default } => {
            let options = options.iter().map(|(id, label)| Choice { id: id.clone(), label: label.clone() }).collect();
            Input::Pick { options, default: default.clone() }
        }
    };
    Control { id: c.id.clone(), label: c.label.clone(), help: c.help.clone(), layers: c.layers.clone(), input }
}

/// The message with the training curve: every n-th training value if there are many, and all held-out values.
pub fn history(points: &[ViewPoint]) -> ServerMessage {
    let nth = points.len().div_ceil(MOST_POINTS).max(1);
    let finite = |v: Option<f64>| v.filter(|v| v.is_finite());
    let shown = points.iter().enumerate().filter(|(i, p)| i % nth == 0 || p.held_out.is_some() || i + 1 == points.len());
    ServerMessage::History { points: shown.map(|(_, p)| (p.step as f64, finite(p.psnr), finite(p.held_out))).collect() }
}

/// Checks control values from a page against the source's controls.
///
/// # Errors
/// One line, if there is no such control or it does not accept its value.
pub fn values(controls: &[ViewControl], given: BTreeMap<String, Value>) -> Result<ControlValues, String> {
    let value = |v| match v {
        Value::Number(v) => ControlValue::Number(v),
        Value::Switch(v) => ControlValue::Switch(v),
        Value::Choice(v) => ControlValue::Choice(v),
    };
    ControlValues::checked(controls, given.into_iter().map(|(id, v)| (id, value(v))))
}

/// A scene with one layer, for tests and fuzzing.
pub fn with_layer(id: &str) -> ViewScene {
    ViewScene {
        name: String::new(),
        frames: Vec::new(),
        layers: vec![ViewLayer::new(id, id)],
        controls: Vec::new(),
        note: String::new(),
        is_run: false,
        focus: [0.0; 3],
        distance: 1.0,
        world_from_capture: diorama_geom::Similarity::IDENTITY,
        bounds: ([-1.0; 3], [1.0; 3]),
        crop: None,
        measured: None,
        path: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_curves_are_thinned_and_keep_what_was_held_out() {
        let point = |i: u64| ViewPoint { step: i, psnr: Some(i as f64), held_out: (i == 777).then_some(20.0) };
        let ServerMessage::History { points } = history(&(0..4000).map(point).collect::<Vec<_>>()) else { panic!("no curve") };
        assert!((400..500).contains(&points.len()), "{}", points.len());
        assert!(points.contains(&(777.0, Some(777.0), Some(20.0))) && points.last() == Some(&(3999.0, Some(3999.0), None)));
        let infinite = [ViewPoint { step: 1, psnr: Some(f64::INFINITY), held_out: None }];
        assert_eq!(history(&infinite), ServerMessage::History { points: vec![(1.0, None, None)] });
    }
}
