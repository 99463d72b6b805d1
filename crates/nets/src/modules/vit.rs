//! Vision transformer (Dosovitskiy et al. 2021): patches as tokens, blocks of attention and a perceptron, a class token.

use crate::bridge::OpError;
use crate::layers::{Conv2d, Init, LayerNorm, Linear};
use crate::ops::{self, Activation, Conv};
use crate::param::{Mode, Module, Param, Visitor};
use crate::weights::{KeyMap, Rule};
use burn::tensor::Tensor;

/// Size of a vision transformer.
#[derive(Clone, Copy, Debug)]
pub struct VitSettings {
    /// Pixels of an image's side, and of a patch's.
    pub image_px: usize,
    pub patch_px: usize,
    pub width: usize,
    pub depth: usize,
    pub heads: usize,
    /// Width between the two layers of the perceptron.
    pub hidden: usize,
}

impl VitSettings {
    pub const B_32: VitSettings = VitSettings { image_px: 224, patch_px: 32, width: 768, depth: 12, heads: 12, hidden: 3072 };
}

/// From the names of torchvision's `vit_b_32` to ours; its attention's joint weights are ours, transposed.
pub const VIT_KEYS: KeyMap = KeyMap {
    rules: &[
        Rule::rename("class_token", "class_token"),
        Rule::rename("conv_proj", "conv_proj"),
        Rule::rename("encoder.pos_embedding", "pos_embedding"),
        Rule::rename("encoder.ln", "ln"),
        Rule::rename("encoder.layers.encoder_layer_*.ln_1", "layers.*.ln_1"),
        Rule::rename("encoder.layers.encoder_layer_*.ln_2", "layers.*.ln_2"),
        Rule::transpose("encoder.layers.encoder_layer_*.self_attention.in_proj_weight", "layers.*.qkv.weight"),
        Rule::rename("encoder.layers.encoder_layer_*.self_attention.in_proj_bias", "layers.*.qkv.bias"),
        Rule::transpose("encoder.layers.encoder_layer_*.self_attention.out_proj.weight", "layers.*.out.weight"),
        Rule::rename("encoder.layers.encoder_layer_*.self_attention.out_proj.bias", "layers.*.out.bias"),
        Rule::transpose("encoder.layers.encoder_layer_*.mlp.0.weight", "layers.*.mlp.0.weight"),
        Rule::rename("encoder.layers.encoder_layer_*.mlp.0.bias", "layers.*.mlp.0.bias"),
        Rule::transpose("encoder.layers.encoder_layer_*.mlp.3.weight", "layers.*.mlp.1.weight"),
        Rule::rename("encoder.layers.encoder_layer_*.mlp.3.bias", "layers.*.mlp.1.bias"),
    ],
    ignored: &[],
};

#[derive(Debug)]
struct Block {
    ln_1: LayerNorm,
    qkv: Linear,
    out: Linear,
    ln_2: LayerNorm,
    mlp: [Linear; 2],
    heads: usize,
}

impl Block {
    fn new(init: &mut Init, s: &VitSettings) -> Block {
        let norm = |init: &Init| LayerNorm::new(init, s.width, 1e-6);
        Block {
            ln_1: norm(init),
            qkv: Linear::new(init, s.width, 3 * s.width, Activation::None),
            out: Linear::new(init, s.width, s.width, Activation::None),
            ln_2: norm(init),
            mlp: [Linear::new(init, s.width, s.hidden, Activation::Gelu), Linear::new(init, s.hidden, s.width, Activation::None)],
            heads: s.heads,
        }
    }

    fn forward(&self, x: Tensor<3>, mode: Mode) -> Result<Tensor<3>, OpError> {
        let [x, skip] = ops::fork(x)?;
        let [q, k, v] = ops::split_heads(self.qkv.forward(self.ln_1.forward(x, mode)?, mode)?, self.heads)?;
        let attended = ops::merge_heads(ops::attention(q, k, v, false)?, self.heads)?;
        let x = ops::add(self.out.forward(attended, mode)?, skip)?;
        let [x, skip] = ops::fork(x)?;
        let x = self.mlp[0].forward(self.ln_2.forward(x, mode)?, mode)?;
        ops::add(self.mlp[1].forward(x, mode)?, skip)
    }
}

impl Module for Block {
    fn visit(&self, v: &mut Visitor) {
        v.part("ln_1", &self.ln_1);
        v.part("qkv", &self.qkv);
        v.part("out", &self.out);
        v.part("ln_2", &self.ln_2);
        v.parts("mlp", &self.mlp);
    }
}

/// A vision transformer without its classifier.
#[derive(Debug)]
pub struct Vit {
    conv_proj: Conv2d,
    class_token: Param,
    pos_embedding: Param,
    layers: Vec<Block>,
    ln: LayerNorm,
}

impl Vit {
    /// # Panics
    /// When the width does not divide by the heads, or the image by the patch.
    pub fn new(init: &mut Init, s: VitSettings) -> Vit {
        assert!(s.width.is_multiple_of(s.heads) && s.image_px.is_multiple_of(s.patch_px), "a vision transformer of {s:?}");
        let side = s.image_px / s.patch_px;
        Vit {
            conv_proj: Conv2d::new(init, [3, s.width], s.patch_px, Conv::default().stride(s.patch_px)),
            class_token: init.normal(&[1, 1, s.width], 0.02),
            pos_embedding: init.normal(&[1, side * side + 1, s.width], 0.02),
            layers: (0..s.depth).map(|_| Block::new(init, &s)).collect(),
            ln: LayerNorm::new(init, s.width, 1e-6),
        }
    }

    /// All tokens, the class token first.
    ///
    /// # Shapes
    /// x `[N, 3, H, W]` of the settings' size; result `[N, patches + 1, width]`.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Result<Tensor<3>, OpError> {
        let patches = ops::to_tokens(self.conv_proj.forward(x, mode)?)?;
        let mut x = ops::with_class_token(patches, self.class_token.tensor(mode), self.pos_embedding.tensor(mode))?;
        for layer in &self.layers {
            x = layer.forward(x, mode)?;
        }
        self.ln.forward(x, mode)
    }
}

impl Module for Vit {
    fn visit(&self, v: &mut Visitor) {
        v.part("conv_proj", &self.conv_proj);
        v.param("class_token", &self.class_token);
        v.param("pos_embedding", &self.pos_embedding);
        v.parts("layers", &self.layers);
        v.part("ln", &self.ln);
    }
}
