//! Nodes of burn's graph for an op with any number of inputs and outputs.
//!
//! burn's ops have a fixed number of inputs and one output. Therefore inputs are the parents of a chain of nodes with [`WIDTH`]
//! parents each, the last of which, the head, runs the op's backward and leaves for the others what is theirs. A single output is
//! the head itself; several are children of the head, whose backward only leaves their gradient behind.

use super::{OpRef, SliceKernels};
use burn::backend::Autodiff;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use std::sync::{Arc, Mutex, MutexGuard};

/// Parents of a node; where there are fewer, the first one is repeated, which changes nothing.
const WIDTH: usize = 4;

type Tracked<B> = FloatTensor<Autodiff<B>>;

/// Gradients on their way from one node to another.
#[derive(Debug)]
struct Slots<B: SliceKernels>(Arc<Mutex<Vec<Option<FloatTensor<B>>>>>);

impl<B: SliceKernels> Clone for Slots<B> {
    fn clone(&self) -> Self {
        Slots(self.0.clone())
    }
}

impl<B: SliceKernels> Slots<B> {
    fn new(n: usize) -> Self {
        Slots(Arc::new(Mutex::new(vec![None; n])))
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Option<FloatTensor<B>>>> {
        self.0.lock().expect("no other holder panicked")
    }
}

/// State of a node of the chain: the inputs that are its parents, from `first` on, and where their gradients lie.
#[derive(Clone, Debug)]
struct Link<B: SliceKernels> {
    first: usize,
    count: usize,
    d_inputs: Slots<B>,
    head: Option<Head<B>>,
}

/// What the head runs the backward with.
#[derive(Clone, Debug)]
struct Head<B: SliceKernels> {
    op: OpRef,
    state: B::State,
    wanted: Vec<bool>,
    /// Gradients of several outputs; without it the head is the output.
    d_outputs: Option<Slots<B>>,
}

#[derive(Debug)]
struct LinkStep;

impl<B: SliceKernels> Backward<B, WIDTH> for LinkStep {
    type State = Link<B>;

    fn backward(self, ops: Ops<Link<B>, WIDTH>, grads: &mut Gradients, _: &mut Checkpointer) {
        let link = ops.state;
        if let Some(head) = link.head {
            let d_outputs = match &head.d_outputs {
                Some(slots) => std::mem::take(&mut *slots.lock()),
                None => vec![Some(grads.consume::<B>(&ops.node))],
            };
            *link.d_inputs.lock() = B::run_backward(&*head.op, &head.state, d_outputs, &head.wanted);
        }
        let mut d_inputs = link.d_inputs.lock();
        for (i, node) in ops.parents.into_iter().take(link.count).enumerate() {
            let d = d_inputs.get_mut(link.first + i).and_then(Option::take);
            if let (Some(node), Some(d)) = (node, d) {
                grads.register::<B>(node.id, d);
            }
        }
    }
}

#[derive(Debug)]
struct OutputStep;

impl<B: SliceKernels> Backward<B, 1> for OutputStep {
    type State = (Slots<B>, usize);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let d = grads.consume::<B>(&ops.node);
        ops.state.0.lock()[ops.state.1] = Some(d);
    }
}

/// Runs an op and records it where a gradient may be asked of an input.
pub(super) fn record<B: SliceKernels>(op: OpRef, inputs: Vec<Tracked<B>>) -> Vec<Tracked<B>> {
    let wanted: Vec<bool> = inputs.iter().map(|t| t.is_tracked()).collect();
    let primitives = inputs.iter().map(|t| t.primitive().clone()).collect();
    let (mut outputs, state) = B::run(&*op, primitives, &wanted);
    if !wanted.contains(&true) {
        return outputs.into_iter().map(Tracked::<B>::new).collect();
    }
    let unit = B::unit(inputs[0].primitive());
    let d_outputs = (outputs.len() != 1).then(|| Slots::new(outputs.len()));
    let value = if d_outputs.is_none() { outputs.swap_remove(0) } else { unit.clone() };
    let head = Head { op, state, wanted, d_outputs: d_outputs.clone() };
    let head = chain(&inputs, head, value, unit);
    let Some(d_outputs) = d_outputs else { return vec![head] };
    let outputs = outputs.into_iter().enumerate();
    outputs
        .map(|(i, t)| match Backward::<B, 1>::prepare::<NoCheckpointing>(OutputStep, [head.node()]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish((d_outputs.clone(), i), t),
            OpsKind::UnTracked(prep) => prep.finish(t),
        })
        .collect()
}

/// The chain over all inputs; returns its head.
fn chain<B: SliceKernels>(inputs: &[Tracked<B>], head: Head<B>, value: FloatTensor<B>, unit: FloatTensor<B>) -> Tracked<B> {
    let d_inputs = Slots::new(inputs.len());
    let (mut head, mut value) = (Some(head), Some(value));
    let mut last: Option<Tracked<B>> = None;
    let mut first = 0;
    loop {
        let room = if last.is_some() { WIDTH - 1 } else { WIDTH };
        let count = room.min(inputs.len() - first);
        let is_head = first + count == inputs.len();
        // Inputs stand before the link, so that their places are those of their gradients.
        let parents: Vec<&Tracked<B>> = inputs[first..first + count].iter().chain(&last).collect();
        let nodes = std::array::from_fn(|i| parents.get(i).unwrap_or(&parents[0]).node());
        let link = Link { first, count, d_inputs: d_inputs.clone(), head: if is_head { head.take() } else { None } };
        let result = if is_head { value.take() } else { None }.unwrap_or_else(|| unit.clone());
        let node = match Backward::<B, WIDTH>::prepare::<NoCheckpointing>(LinkStep, nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish(link, result),
            OpsKind::UnTracked(prep) => prep.finish(result),
        };
        if is_head {
            return node;
        }
        first += count;
        last = Some(node);
    }
}
