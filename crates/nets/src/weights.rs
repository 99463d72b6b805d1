//! Weights in: names and layouts of other programs' files are mapped to a network's by a table, then everything is checked before
//! anything is written.

use crate::param::{self, Kind, Module};
use diorama_geom::NamedArray;
use std::collections::HashMap;

/// How many mismatches an error lists.
const LISTED: usize = 5;

/// How a file's array becomes a network's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    Same,
    /// `[A, B]` to `[B, A]`, as PyTorch's linear weights `[out, in]` to ours `[in, out]`.
    Transposed,
}

/// One line of a key map: names that begin with `theirs` continue with `ours` instead. `*` stands for anything within one
/// segment between dots, which is taken over.
#[derive(Clone, Copy, Debug)]
pub struct Rule {
    pub theirs: &'static str,
    pub ours: &'static str,
    pub layout: Layout,
}

impl Rule {
    pub const fn rename(theirs: &'static str, ours: &'static str) -> Rule {
        Rule { theirs, ours, layout: Layout::Same }
    }

    pub const fn transpose(theirs: &'static str, ours: &'static str) -> Rule {
        Rule { theirs, ours, layout: Layout::Transposed }
    }
}

/// A table of rules, of which the first that fits a name holds; names that none fits stay as they are.
#[derive(Clone, Copy, Debug)]
pub struct KeyMap {
    pub rules: &'static [Rule],
    /// Names that are left out, by their ends, as `num_batches_tracked`.
    pub ignored: &'static [&'static str],
}

impl KeyMap {
    /// No change, but for the batch counters that PyTorch keeps with its normalization.
    pub const PLAIN: KeyMap = KeyMap { rules: &[], ignored: &["num_batches_tracked"] };

    /// The network's name and the layout of a file's array; `None` where it is left out.
    pub fn map(&self, theirs: &str) -> Option<(String, Layout)> {
        if self.ignored.iter().any(|end| theirs.ends_with(end)) {
            return None;
        }
        let found = self.rules.iter().find_map(|r| Some((renamed(r, theirs)?, r.layout)));
        Some(found.unwrap_or_else(|| (theirs.to_string(), Layout::Same)))
    }
}

/// The name that a rule makes of another, where it fits.
fn renamed(rule: &Rule, name: &str) -> Option<String> {
    let segments: Vec<&str> = name.split('.').collect();
    let pattern: Vec<&str> = rule.theirs.split('.').collect();
    if segments.len() < pattern.len() {
        return None;
    }
    let mut stars = Vec::new();
    for (s, p) in segments.iter().zip(&pattern) {
        match p.split_once('*') {
            Some((before, after)) => stars.push(s.strip_prefix(before)?.strip_suffix(after)?),
            None if p == s => {}
            None => return None,
        }
    }
    let mut stars = stars.into_iter();
    let ours = rule.ours.split('.').filter(|s| !s.is_empty());
    let mut filled = |s: &str| if s.contains('*') { s.replacen('*', stars.next().unwrap_or_default(), 1) } else { s.to_string() };
    let mut out: Vec<String> = ours.map(&mut filled).collect();
    out.extend(segments[pattern.len()..].iter().map(|s| s.to_string()));
    Some(out.join("."))
}

/// Why a file does not fit a network.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the weights do not fit the network: {}{}", listed.join("; "), if *more > 0 { format!("; and {more} more") } else { String::new() })]
pub struct Mismatch {
    /// The first five, missing arrays first, then wrong shapes, then unexpected arrays.
    pub listed: Vec<String>,
    pub more: usize,
}

/// What a load leaves out on purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strictness {
    /// Every array of the file and of the network must have its partner.
    Exact,
    /// The file may hold arrays that the network has no use for, as a classifier's head.
    AllowUnexpected,
}

/// Fills a network's parameters from a file's arrays.
///
/// # Errors
/// [`Mismatch`], after which nothing is changed.
pub fn load(module: &dyn Module, arrays: &[NamedArray], map: &KeyMap, strictness: Strictness) -> Result<(), Mismatch> {
    let mut by_name: HashMap<String, (&NamedArray, Layout)> = HashMap::new();
    let mut twice = Vec::new();
    for a in arrays {
        let Some((name, layout)) = map.map(&a.name) else { continue };
        if by_name.insert(name.clone(), (a, layout)).is_some() {
            twice.push(format!("two arrays stand for {name}"));
        }
    }
    let (mut missing, mut wrong) = (Vec::new(), Vec::new());
    let mut found: Vec<Vec<f32>> = Vec::new();
    param::visit(module, &mut |name, p| match by_name.remove(name) {
        None => missing.push(format!("{name} is missing")),
        Some((a, layout)) => {
            let (shape, values) = arranged(a, layout);
            if shape == p.shape() {
                found.push(values);
            } else {
                wrong.push(format!("{name} has shape {shape:?}, expected {:?}", p.shape()));
            }
        }
    });
    let mut unexpected: Vec<String> = by_name.values().map(|(a, _)| format!("{} is unexpected", a.name)).collect();
    unexpected.sort();
    if strictness == Strictness::AllowUnexpected {
        unexpected.clear();
    }
    let all: Vec<String> = missing.into_iter().chain(wrong).chain(twice).chain(unexpected).collect();
    if !all.is_empty() {
        return Err(Mismatch { more: all.len().saturating_sub(LISTED), listed: all.into_iter().take(LISTED).collect() });
    }
    let mut found = found.into_iter();
    param::visit(module, &mut |_, p| {
        let values = found.next().expect("one for each parameter");
        p.write(|v| v.copy_from_slice(&values));
    });
    Ok(())
}

fn arranged(a: &NamedArray, layout: Layout) -> (Vec<usize>, Vec<f32>) {
    match (layout, &a.shape[..]) {
        (Layout::Transposed, &[rows, columns]) => {
            let values = (0..a.values.len()).map(|i| a.values[i % rows * columns + i / rows]).collect();
            (vec![columns, rows], values)
        }
        _ => (a.shape.clone(), a.values.clone()),
    }
}

/// Whether all numbers of a network are finite; the first name that has others.
pub fn first_broken(module: &dyn Module) -> Option<String> {
    let mut broken = None;
    param::visit(module, &mut |name, p| {
        if broken.is_none() && p.kind() == Kind::Weight && p.values().iter().any(|v| !v.is_finite()) {
            broken = Some(name.to_string());
        }
    });
    broken
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::param::{Mode, Param, Visitor};
    use burn::tensor::Device;

    struct Layer {
        weight: Param,
        bias: Param,
    }

    impl Module for Layer {
        fn visit(&self, v: &mut Visitor) {
            v.param("weight", &self.weight);
            v.param("bias", &self.bias);
        }
    }

    struct Net(Vec<Layer>);

    impl Module for Net {
        fn visit(&self, v: &mut Visitor) {
            v.parts("layers", &self.0);
        }
    }

    fn net() -> Net {
        let zero = |shape: &[usize]| Param::constant(Kind::Weight, shape, 0.0, &Device::flex());
        Net((0..2).map(|_| Layer { weight: zero(&[2, 3]), bias: zero(&[3]) }).collect())
    }

    fn file() -> Vec<NamedArray> {
        let of = |i: usize| {
            [
                NamedArray::new(format!("module.fc.{i}.weight"), &[3, 2], (0..6).map(|v| (v + 10 * i) as f32).collect()),
                NamedArray::new(format!("module.fc.{i}.bias"), &[3], vec![i as f32; 3]),
                NamedArray::new(format!("module.fc.{i}.num_batches_tracked"), &[1], vec![7.0]),
            ]
        };
        (0..2).flat_map(of).collect()
    }

    const MAP: KeyMap = KeyMap {
        rules: &[Rule::transpose("module.fc.*.weight", "layers.*.weight"), Rule::rename("module.fc", "layers")],
        ignored: &["num_batches_tracked"],
    };

    #[test]
    fn names_and_layouts_go_by_the_table() {
        let net = net();
        load(&net, &file(), &MAP, Strictness::Exact).unwrap();
        assert_eq!(net.0[1].weight.values(), [10.0, 12.0, 14.0, 11.0, 13.0, 15.0]);
        assert_eq!(net.0[1].bias.values(), [1.0; 3]);
        assert_eq!(net.0[0].bias.tensor::<1>(Mode::Eval).dims(), [3]);
    }

    #[test]
    fn the_first_five_mismatches_are_listed_and_nothing_is_changed() {
        let net = net();
        let mut file = file();
        file[0].shape = vec![2, 3];
        file.remove(1);
        file.extend((0..6).map(|i| NamedArray::new(format!("extra{i}"), &[1], vec![0.0])));
        let e = load(&net, &file, &MAP, Strictness::Exact).unwrap_err();
        assert_eq!((e.listed.len(), e.more), (5, 3));
        let text = e.to_string();
        assert!(
            text.contains("layers.0.bias is missing; layers.0.weight has shape [3, 2], expected [2, 3]; extra0 is unexpected"),
            "{text}"
        );
        assert!(text.ends_with("and 3 more"), "{text}");
        assert_eq!(net.0[1].bias.values(), [0.0; 3]);
    }

    #[test]
    fn unexpected_arrays_are_allowed_where_told() {
        let mut file = file();
        file.push(NamedArray::new("head", &[1], vec![0.0]));
        assert!(load(&net(), &file, &MAP, Strictness::Exact).is_err());
        load(&net(), &file, &MAP, Strictness::AllowUnexpected).unwrap();
    }
}
