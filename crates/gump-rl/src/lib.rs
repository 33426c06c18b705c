//! A vectorised environment, replay buffers and policy learning.
