//! What is good and what is bad: metrics of rollouts and rewards made of them.
