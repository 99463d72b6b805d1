//! Networks as ONNX models: a graph is built op by op with the weights of layers, and encoded as the file's bytes.
//!
//! Only what our networks need is here. Images are `[N, C, H, W]`; batch and size are free where a value's axes are named.

mod wire;

use crate::layers::{BatchNorm, Conv2d, ConvTranspose2d};
use crate::ops::{Activation, Conv};
use crate::param::Param;
use wire::Message;

/// Version of the ops that graphs use.
const OPSET: u64 = 13;
/// Version of the file format.
const IR_VERSION: u64 = 8;
/// Numbers of ONNX's data types.
const FLOAT: u64 = 1;
const INT64: u64 = 7;
/// Numbers of ONNX's attribute types.
const ATTRIBUTE_FLOAT: u64 = 1;
const ATTRIBUTE_INT: u64 = 2;
const ATTRIBUTE_STRING: u64 = 3;
const ATTRIBUTE_INTS: u64 = 7;

/// Name of a value in a graph.
#[derive(Clone, Debug, PartialEq)]
pub struct Value(String);

/// An axis of an input or output.
#[derive(Clone, Copy, Debug)]
pub enum Axis {
    Is(usize),
    Named(&'static str),
}

/// An attribute of a node.
#[derive(Clone, Copy, Debug)]
enum Attribute<'a> {
    Float(f32),
    Int(i64),
    Text(&'a str),
    Ints(&'a [usize]),
}

/// A graph under construction.
#[derive(Default)]
pub struct Graph {
    nodes: Vec<Message>,
    initializers: Vec<Message>,
    inputs: Vec<Message>,
    outputs: Vec<Message>,
    values: usize,
}

impl Graph {
    /// An empty graph.
    pub fn new() -> Graph {
        Graph::default()
    }

    fn fresh(&mut self, of: &str) -> Value {
        self.values += 1;
        Value(format!("{of}_{}", self.values))
    }

    /// An input of numbers in f32.
    pub fn input(&mut self, name: &str, axes: &[Axis]) -> Value {
        self.inputs.push(typed(name, axes));
        Value(name.into())
    }

    /// Gives a value as an output of a name.
    pub fn output(&mut self, name: &str, value: &Value, axes: &[Axis]) {
        self.outputs.push(typed(name, axes));
        let mut node = Message::default();
        node.text(1, &value.0);
        node.text(2, name);
        node.text(4, "Identity");
        self.nodes.push(node);
    }

    /// A constant of f32.
    pub fn constant(&mut self, shape: &[usize], values: &[f32]) -> Value {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.initializer(FLOAT, shape, &bytes)
    }

    fn integers(&mut self, values: &[i64]) -> Value {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.initializer(INT64, &[values.len()], &bytes)
    }

    fn initializer(&mut self, kind: u64, shape: &[usize], bytes: &[u8]) -> Value {
        let name = self.fresh("weight");
        let mut tensor = Message::default();
        shape.iter().for_each(|n| tensor.integer(1, *n as u64));
        tensor.integer(2, kind);
        tensor.text(8, &name.0);
        tensor.bytes(9, bytes);
        self.initializers.push(tensor);
        name
    }

    fn param(&mut self, p: &Param) -> Value {
        p.read(|v| self.constant(p.shape(), v))
    }

    /// The first output of an op.
    fn node(&mut self, op: &str, inputs: &[&Value], attributes: &[(&str, Attribute)]) -> Value {
        let out = self.fresh(&op.to_lowercase());
        let mut node = Message::default();
        inputs.iter().for_each(|i| node.text(1, &i.0));
        node.text(2, &out.0);
        node.text(3, &out.0);
        node.text(4, op);
        attributes.iter().for_each(|(name, value)| node.message(5, &attribute(name, *value)));
        self.nodes.push(node);
        out
    }

    fn with_activation(&mut self, x: Value, f: Activation) -> Value {
        match f {
            Activation::None => x,
            Activation::Relu => self.node("Relu", &[&x], &[]),
            Activation::Sigmoid => self.node("Sigmoid", &[&x], &[]),
            Activation::Tanh => self.node("Tanh", &[&x], &[]),
            Activation::Softplus => self.node("Softplus", &[&x], &[]),
            Activation::LeakyRelu(slope) => self.node("LeakyRelu", &[&x], &[("alpha", Attribute::Float(slope))]),
            Activation::Silu => {
                let gate = self.node("Sigmoid", &[&x], &[]);
                self.mul(&x, &gate)
            }
            Activation::Gelu | Activation::GeluTanh => unreachable!("no exported network has it"),
        }
    }

    /// A convolution with bias and activation.
    pub fn conv(&mut self, x: &Value, layer: &Conv2d) -> Value {
        self.convolution("Conv", x, (&layer.weight, layer.bias.as_ref()), &layer.settings)
    }

    /// A transposed convolution with bias and activation.
    pub fn conv_transpose(&mut self, x: &Value, layer: &ConvTranspose2d) -> Value {
        self.convolution("ConvTranspose", x, (&layer.weight, layer.bias.as_ref()), &layer.settings)
    }

    fn convolution(&mut self, op: &str, x: &Value, (weight, bias): (&Param, Option<&Param>), s: &Conv) -> Value {
        let kernel = [weight.shape()[2], weight.shape()[3]];
        let [top, left] = s.padding;
        let pads = [top, left, top, left];
        let mut attributes = vec![
            ("kernel_shape", Attribute::Ints(&kernel)),
            ("strides", Attribute::Ints(&s.stride)),
            ("pads", Attribute::Ints(&pads)),
            ("dilations", Attribute::Ints(&s.dilation)),
            ("group", Attribute::Int(s.groups as i64)),
        ];
        if op == "ConvTranspose" {
            attributes.push(("output_padding", Attribute::Ints(&s.output_padding)));
        }
        let weight = self.param(weight);
        let bias = bias.map(|b| self.param(b));
        let inputs: Vec<&Value> = [x, &weight].into_iter().chain(&bias).collect();
        let out = self.node(op, &inputs, &attributes);
        self.with_activation(out, s.activation)
    }

    /// Batch normalization by the running statistics, with activation.
    pub fn batch_norm(&mut self, x: &Value, layer: &BatchNorm) -> Value {
        let parts = [&layer.weight, &layer.bias, &layer.running_mean, &layer.running_var].map(|p| self.param(p));
        let inputs: Vec<&Value> = std::iter::once(x).chain(&parts).collect();
        let out = self.node("BatchNormalization", &inputs, &[("epsilon", Attribute::Float(layer.settings.epsilon))]);
        self.with_activation(out, layer.settings.activation)
    }

    /// An activation.
    pub fn activation(&mut self, x: &Value, f: Activation) -> Value {
        self.with_activation(x.clone(), f)
    }

    /// Largest values of square windows.
    pub fn max_pool(&mut self, x: &Value, kernel: usize, stride: usize, padding: usize) -> Value {
        let attributes = [
            ("kernel_shape", Attribute::Ints(&[kernel; 2])),
            ("strides", Attribute::Ints(&[stride; 2])),
            ("pads", Attribute::Ints(&[padding; 4])),
        ];
        self.node("MaxPool", &[x], &attributes)
    }

    /// `a + b`
    pub fn add(&mut self, a: &Value, b: &Value) -> Value {
        self.node("Add", &[a, b], &[])
    }

    /// `a · b`
    pub fn mul(&mut self, a: &Value, b: &Value) -> Value {
        self.node("Mul", &[a, b], &[])
    }

    /// Joins along the channels.
    pub fn concat(&mut self, parts: &[&Value]) -> Value {
        self.node("Concat", parts, &[("axis", Attribute::Int(1))])
    }

    /// Channels `from..to`.
    pub fn channels(&mut self, x: &Value, from: usize, to: usize) -> Value {
        let [starts, ends, axes] = [from as i64, to as i64, 1].map(|v| self.integers(&[v]));
        self.node("Slice", &[x, &starts, &ends, &axes], &[])
    }

    /// Images `factor` times as large, bilinear by pixel centers or by repeating pixels.
    pub fn enlarge(&mut self, x: &Value, factor: usize, is_bilinear: bool) -> Value {
        let scales = self.constant(&[4], &[1.0, 1.0, factor as f32, factor as f32]);
        let (mode, coordinates) = if is_bilinear { ("linear", "half_pixel") } else { ("nearest", "asymmetric") };
        let attributes = [
            ("mode", Attribute::Text(mode)),
            ("coordinate_transformation_mode", Attribute::Text(coordinates)),
            ("nearest_mode", Attribute::Text("floor")),
        ];
        // No region of interest.
        self.node("Resize", &[x, &Value(String::new()), &scales], &attributes)
    }

    /// The bytes of an ONNX file; `metadata` are pairs of a key and a text.
    pub fn encode(&self, name: &str, metadata: &[(&str, &str)]) -> Vec<u8> {
        let mut graph = Message::default();
        self.nodes.iter().for_each(|m| graph.message(1, m));
        graph.text(2, name);
        self.initializers.iter().for_each(|m| graph.message(5, m));
        self.inputs.iter().for_each(|m| graph.message(11, m));
        self.outputs.iter().for_each(|m| graph.message(12, m));
        let mut opset = Message::default();
        opset.text(1, "");
        opset.integer(2, OPSET);
        let mut model = Message::default();
        model.integer(1, IR_VERSION);
        model.text(2, "diorama");
        model.message(7, &graph);
        model.message(8, &opset);
        for (key, value) in metadata {
            let mut entry = Message::default();
            entry.text(1, key);
            entry.text(2, value);
            model.message(14, &entry);
        }
        model.into_bytes()
    }
}

fn attribute(name: &str, value: Attribute) -> Message {
    let mut m = Message::default();
    m.text(1, name);
    let kind = match value {
        Attribute::Float(v) => {
            m.float(2, v);
            ATTRIBUTE_FLOAT
        }
        Attribute::Int(v) => {
            m.integer(3, v as u64);
            ATTRIBUTE_INT
        }
        Attribute::Text(v) => {
            m.text(4, v);
            ATTRIBUTE_STRING
        }
        Attribute::Ints(v) => {
            v.iter().for_each(|v| m.integer(8, *v as u64));
            ATTRIBUTE_INTS
        }
    };
    m.integer(20, kind);
    m
}

/// Name, type and shape of an input or output.
fn typed(name: &str, axes: &[Axis]) -> Message {
    let mut shape = Message::default();
    for axis in axes {
        let mut dim = Message::default();
        match axis {
            Axis::Is(n) => dim.integer(1, *n as u64),
            Axis::Named(n) => dim.text(2, n),
        }
        shape.message(1, &dim);
    }
    let (mut tensor, mut kind, mut value) = (Message::default(), Message::default(), Message::default());
    tensor.integer(1, FLOAT);
    tensor.message(2, &shape);
    kind.message(1, &tensor);
    value.text(1, name);
    value.message(2, &kind);
    value
}
