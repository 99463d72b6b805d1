//! Layers and controls of a viewer: the pictures that a source can render of a view, and the settings that change them.
//!
//! A source lists both in its [`ViewScene`](crate::view_source::ViewScene); the page builds its buttons, sliders and legends from the lists.

use std::collections::{BTreeMap, BTreeSet};

/// A kind of picture that a source renders of a view, such as depth.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewLayer {
    /// Identifier in requests.
    pub id: String,
    /// Label on the page.
    pub label: String,
    pub legend: Option<Legend>,
}

impl ViewLayer {
    /// A layer without a legend.
    pub fn new(id: &str, label: &str) -> ViewLayer {
        ViewLayer { id: id.into(), label: label.into(), legend: None }
    }

    /// Adds a color scale as legend.
    pub fn with_scale(self, colors: &[[u8; 3]], low: &str, high: &str, unit: &str) -> ViewLayer {
        let legend = Legend::Scale { colors: colors.to_vec(), low: low.into(), high: high.into(), unit: unit.into() };
        ViewLayer { legend: Some(legend), ..self }
    }

    /// Adds a legend that lists what each color means.
    pub fn with_classes(self, classes: &[(&str, [u8; 3])]) -> ViewLayer {
        let legend = Legend::Classes(classes.iter().map(|(label, color)| (label.to_string(), *color)).collect());
        ViewLayer { legend: Some(legend), ..self }
    }
}

/// Legend of a layer. Colors are sRGB.
#[derive(Clone, Debug, PartialEq)]
pub enum Legend {
    /// Values from `low` to `high`; the `colors` are spaced evenly between them.
    Scale { colors: Vec<[u8; 3]>, low: String, high: String, unit: String },
    /// A name for each color.
    Classes(Vec<(String, [u8; 3])>),
}

/// A setting of the views that a source renders.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewControl {
    /// Identifier in requests.
    pub id: String,
    /// Label on the page.
    pub label: String,
    /// One sentence of help; may be empty.
    pub help: String,
    /// Ids of the layers that it changes; empty: all layers.
    pub layers: Vec<String>,
    pub input: ControlInput,
}

/// The kind of a control and the values that it accepts.
#[derive(Clone, Debug, PartialEq)]
pub enum ControlInput {
    Slider {
        min: f64,
        max: f64,
        step: f64,
        unit: String,
        default: f64,
    },
    Toggle {
        default: bool,
    },
    /// One of `options`, each with an id and its label on the page.
    Pick {
        options: Vec<(String, String)>,
        default: String,
    },
}

impl ControlInput {
    fn default_value(&self) -> ControlValue {
        match self {
            ControlInput::Slider { default, .. } => ControlValue::Number(*default),
            ControlInput::Toggle { default } => ControlValue::Switch(*default),
            ControlInput::Pick { default, .. } => ControlValue::Choice(default.clone()),
        }
    }

    fn takes(&self, value: &ControlValue) -> bool {
        match (self, value) {
            (ControlInput::Slider { min, max, .. }, ControlValue::Number(v)) => (*min..=*max).contains(v),
            (ControlInput::Toggle { .. }, ControlValue::Switch(_)) => true,
            (ControlInput::Pick { options, .. }, ControlValue::Choice(c)) => options.iter().any(|(id, _)| id == c),
            _ => false,
        }
    }
}

/// The value of one control.
#[derive(Clone, Debug, PartialEq)]
pub enum ControlValue {
    Number(f64),
    Switch(bool),
    /// Id of an option.
    Choice(String),
}

/// One accepted value for each control of a source.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ControlValues(BTreeMap<String, ControlValue>);

impl ControlValues {
    /// The controls' defaults.
    pub fn defaults(controls: &[ViewControl]) -> ControlValues {
        ControlValues(controls.iter().map(|c| (c.id.clone(), c.input.default_value())).collect())
    }

    /// The given values, with defaults for controls that are not given.
    ///
    /// # Errors
    /// One line, if there is no such control or a control does not accept its value.
    pub fn checked(controls: &[ViewControl], given: impl IntoIterator<Item = (String, ControlValue)>) -> Result<ControlValues, String> {
        let mut values = ControlValues::defaults(controls);
        for (id, value) in given {
            let control = controls.iter().find(|c| c.id == id).ok_or_else(|| format!("there is no control {id:?}"))?;
            if !control.input.takes(&value) {
                return Err(format!("control {id:?} does not take {value:?}"));
            }
            values.0.insert(id, value);
        }
        Ok(values)
    }

    /// Value of a slider.
    ///
    /// # Panics
    /// If the source has no slider `id`.
    pub fn number(&self, id: &str) -> f64 {
        match self.0.get(id) {
            Some(ControlValue::Number(v)) => *v,
            other => panic!("no slider {id:?}: {other:?}"),
        }
    }

    /// State of a toggle.
    ///
    /// If the source has no toggle `id`.
    /// When the source has listed no toggle `id`.
    pub fn switch(&self, id: &str) -> bool {
        match self.0.get(id) {
            Some(ControlValue::Switch(v)) => *v,
            other => panic!("no toggle {id:?}: {other:?}"),
        }
    }

    /// Id of the chosen option of a pick.
    ///
    /// # Panics
    /// If the source has no pick `id`.
    pub fn choice(&self, id: &str) -> &str {
        match self.0.get(id) {
            Some(ControlValue::Choice(v)) => v,
            other => panic!("no pick {id:?}: {other:?}"),
        }
    }
}

/// Checks a source's lists: at least one layer, unique ids, defaults that their controls accept, and controls that name existing layers.
///
/// # Errors
/// One line that names the layer or control.
pub fn check_lists(layers: &[ViewLayer], controls: &[ViewControl]) -> Result<(), String> {
    let ids: BTreeSet<&str> = layers.iter().map(|l| &l.id[..]).collect();
    if layers.is_empty() || ids.len() < layers.len() {
        return Err("layers: there must be at least one, and ids must be unique".into());
    }
    let mut seen = BTreeSet::new();
    for c in controls {
        let well_formed = match &c.input {
            ControlInput::Slider { min, max, step, .. } => min < max && *step > 0.0 && [min, max, step].iter().all(|v| v.is_finite()),
            _ => true,
        };
        if !well_formed || !c.input.takes(&c.input.default_value()) {
            return Err(format!("control {:?}: does not take its default", c.id));
        }
        if !seen.insert(&c.id) {
            return Err(format!("control {:?}: appears twice", c.id));
        }
        if let Some(l) = c.layers.iter().find(|l| !ids.contains(&l[..])) {
            return Err(format!("control {:?}: there is no layer {l:?}", c.id));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn controls() -> Vec<ViewControl> {
        let control =
            |id: &str, input| ViewControl { id: id.into(), label: id.into(), help: String::new(), layers: vec!["albedo".into()], input };
        let options = ["front", "back"].map(|o| (o.to_string(), o.to_uppercase())).to_vec();
        vec![
            control("sun", ControlInput::Slider { min: 0.0, max: 90.0, step: 1.0, unit: "°".into(), default: 40.0 }),
            control("shadows", ControlInput::Toggle { default: true }),
            control("side", ControlInput::Pick { options, default: "front".into() }),
        ]
    }

    #[test]
    fn values_are_those_that_their_controls_take() {
        let one = |id: &str, v| ControlValues::checked(&controls(), [(id.to_string(), v)]);
        let v = one("sun", ControlValue::Number(90.0)).unwrap();
        assert_eq!((v.number("sun"), v.switch("shadows"), v.choice("side")), (90.0, true, "front"));
        assert_eq!(one("side", ControlValue::Choice("back".into())).unwrap().choice("side"), "back");
        for (id, v) in [
            ("sun", ControlValue::Number(90.5)),
            ("sun", ControlValue::Number(f64::NAN)),
            ("sun", ControlValue::Switch(true)),
            ("side", ControlValue::Choice("left".into())),
            ("shadows", ControlValue::Number(1.0)),
            ("moon", ControlValue::Number(1.0)),
        ] {
            assert!(one(id, v.clone()).unwrap_err().contains(&format!("{id:?}")), "{id} {v:?}");
        }
    }

    #[test]
    fn lists_that_make_no_sense_are_refused() {
        let layers = [ViewLayer::new("albedo", "Albedo")];
        assert_eq!(check_lists(&layers, &controls()), Ok(()));
        assert!(check_lists(&[], &[]).is_err());
        assert!(check_lists(&[layers[0].clone(), layers[0].clone()], &[]).is_err());
        assert!(check_lists(&[ViewLayer::new("rgb", "Color")], &controls()).unwrap_err().contains("albedo"));
        let mut twice = controls();
        twice.extend(controls());
        assert!(check_lists(&layers, &twice).unwrap_err().contains("twice"));
        let mut out = controls();
        out[0].input = ControlInput::Slider { min: 0.0, max: 1.0, step: 0.1, unit: String::new(), default: 2.0 };
        assert!(check_lists(&layers, &out).unwrap_err().contains("sun"));
    }
}
