//! Networks against what PyTorch computes with the same weights.
