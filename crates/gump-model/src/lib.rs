//! The multimodal causal transformer world model: network, training, inference, checkpoints.
