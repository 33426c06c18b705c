//! Learning from moves of the network's own rollouts, which are rewarded.
//!
//! Moves of positive weight become more likely, the others less likely. Beside that loss it computes
//! how widely the network draws such moves (entropy) and how far it is from a network that serves
//! as reference (divergence), whose gradient can be part of the loss.

use candle_core::{Result, Tensor};
use gump_nn::ops;

use super::RelativeNetwork;
use super::grid::{BINS, FIELDS, STANDS, first_bin};
use super::sample::{Sample, Target};

/// A network to stay near.
#[derive(Clone, Copy, Debug)]
pub struct Anchor<'a> {
    /// The network, which is not changed.
    pub reference: &'a RelativeNetwork,
    /// Weight in the loss of the divergence of one move.
    pub weight: f64,
}

/// What [`RelativeNetwork::preference`] computes for a sample.
#[derive(Debug)]
pub struct Preference {
    /// Part of the loss of a batch, for differentiation.
    pub loss: Tensor,
    /// Weighted sums of the fields' cross-entropies, nats.
    pub sums: [f64; FIELDS],
    /// Sum over moves of the entropy, nats.
    pub entropy: f64,
    /// Sum over moves of the divergence from the reference, nats; 0 without one.
    pub divergence: f64,
}

impl RelativeNetwork {
    /// As [`Self::loss`] with weights of either sign, without smoothing: moves of positive weight
    /// become more likely, those of negative weight less likely.
    ///
    /// Entropy and divergence are sums over all moves of a weight other than zero, whatever it is.
    /// They are those of whole distributions, each field's given the drawn fields before it; fields
    /// after the first count where the agent moves. The divergence is KL(this || reference). Its
    /// gradient is that of these sums, which leaves out that another network would draw other
    /// earlier fields.
    pub fn preference(
        &self,
        sample: &Sample,
        total: f64,
        anchor: Option<Anchor<'_>>,
    ) -> Result<Preference> {
        let outputs = self.forced(sample)?;
        let part = |sign: f32| {
            let weight = move |weight: f32| (sign * weight).max(0.0);
            self.cross_entropy(sample, &outputs, total, 0.0, weight)
        };
        let ((liked, gains), (disliked, losses)) = (part(1.0)?, part(-1.0)?);
        let sums = std::array::from_fn(|field| gains[field] - losses[field]);
        let loss = (liked - disliked)?;
        let Some(anchor) = anchor else {
            let (_, entropy) = self.spread(sample, &outputs.detach(), None)?;
            return Ok(Preference {
                loss,
                sums,
                entropy,
                divergence: 0.0,
            });
        };
        let reference = anchor.reference.move_logits(sample)?;
        let (divergence, entropy) = self.spread(sample, &outputs, Some(&reference))?;
        Ok(Preference {
            loss: (loss + (&divergence * anchor.weight)?)?,
            sums,
            entropy,
            divergence: f64::from(divergence.to_scalar::<f32>()?),
        })
    }

    /// Sums over the moves of divergence from reference logits, for differentiation, and of entropy.
    fn spread(
        &self,
        sample: &Sample,
        outputs: &Tensor,
        reference: Option<&[Tensor; FIELDS]>,
    ) -> Result<(Tensor, f64)> {
        let mut divergence = Tensor::new(0f32, outputs.device())?;
        let mut entropy = 0.0;
        for field in 0..FIELDS {
            let counts = |target: &Target| {
                let is_drawn = field == 0 || target.bins[0] != STANDS;
                f32::from(u8::from(is_drawn && target.weight != 0.0))
            };
            let counts: Vec<f32> = sample.targets.iter().map(counts).collect();
            let logits = self.logits(outputs, field)?;
            entropy += ops::weighted_entropy(&logits, &counts)?;
            if let Some(reference) = reference {
                let of_field = ops::weighted_divergence(&logits, &reference[field], &counts)?;
                divergence = (divergence + of_field)?;
            }
        }
        Ok((divergence, entropy))
    }

    /// Logits of all fields of the moves of a sample, without a way back for gradients.
    fn move_logits(&self, sample: &Sample) -> Result<[Tensor; FIELDS]> {
        let outputs = self.forced(sample)?.detach();
        let mut all = Vec::with_capacity(FIELDS);
        for field in 0..FIELDS {
            all.push(self.logits(&outputs, field)?.detach());
        }
        Ok(all.try_into().expect("one tensor per field"))
    }

    /// Logits of a field, [K, bins], from outputs [FIELDS, K, C].
    fn logits(&self, outputs: &Tensor, field: usize) -> Result<Tensor> {
        let matrix = self.decoder.head.weight();
        let rows = ops::table_rows(matrix, first_bin(field), BINS[field])?;
        ops::linear(&outputs.get(field)?, &rows, None)
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};
    use gump_scene::{Seed, fixture};
    use rand::Rng as _;

    use super::super::RelativeConfig;
    use super::super::sample::{SampleConfig, draw};
    use super::*;

    fn network(seed: u64) -> RelativeNetwork {
        let config = RelativeConfig {
            width: 16,
            layers: 1,
            heads: 2,
            edge_width: 8,
            edge_hidden: 8,
        };
        let network = RelativeNetwork::random(config, Seed(seed), &Device::Cpu).unwrap();
        // An untrained network draws nearly evenly; differences have to be seen in f32.
        let head = network.parameters().find("decoder.head.weight").unwrap();
        head.set(&(head.as_tensor() * 10.0).unwrap()).unwrap();
        network
    }

    fn sample() -> Sample {
        let scenario = fixture::scenario(
            "lane 1: 0,0 60,0 speed 15
             ego vehicle 0: 10,0 velocity 8,0
             agent vehicle 1: 30,0 velocity 0,0
             agent pedestrian 2: 40,5 velocity 0,-1",
        )
        .unwrap();
        let mut sample = draw(&scenario, &SampleConfig::plain(), None, Seed(1)).unwrap();
        sample.weigh(|agent, frame| [1.0, -0.5, 0.0][(agent + frame) % 3]);
        sample
    }

    fn divergence(own: &RelativeNetwork, sample: &Sample, reference: &RelativeNetwork) -> Tensor {
        let reference = reference.move_logits(sample).unwrap();
        let outputs = own.forced(sample).unwrap();
        own.spread(sample, &outputs, Some(&reference)).unwrap().0
    }

    fn flat(tensor: &Tensor) -> Vec<f32> {
        tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap()
    }

    /// Along the gradient and along a random direction, of every parameter.
    #[test]
    fn the_divergence_changes_as_its_gradient_says() {
        let (own, reference, sample) = (network(4), network(5), sample());
        let gradients = divergence(&own, &sample, &reference).backward().unwrap();
        let value = || {
            f64::from(
                divergence(&own, &sample, &reference)
                    .to_scalar::<f32>()
                    .unwrap(),
            )
        };
        assert!(value() > 1.0, "{}", value());
        let slope = |var: &Var, direction: &[f32]| {
            let start = flat(var.as_tensor());
            let norm = direction.iter().map(|d| d * d).sum::<f32>().sqrt();
            let size = start.iter().map(|s| s * s).sum::<f32>().sqrt();
            let far = 3e-3 * size.max(1.0);
            let at = |by: f32| {
                let moved = start.iter().zip(direction);
                let moved = moved.map(|(s, d)| s + by * d / norm).collect();
                var.set(&Tensor::from_vec(moved, var.shape(), &Device::Cpu).unwrap())
                    .unwrap();
                value()
            };
            let found = (at(far) - at(-far)) / (2.0 * f64::from(far));
            at(0.0);
            found
        };
        let mut rng = Seed(9).rng();
        let mut checked = 0;
        for (name, var) in own.parameters().trainable() {
            let Some(gradient) = gradients.get(var.as_tensor()) else {
                continue;
            };
            let gradient = flat(gradient);
            let length = gradient.iter().map(|g| g * g).sum::<f32>().sqrt();
            if length < 1e-2 {
                continue;
            }
            let random: Vec<f32> = gradient
                .iter()
                .map(|_| rng.random_range(-1.0..1.0))
                .collect();
            let size = random.iter().map(|r| r * r).sum::<f32>().sqrt();
            let along: f32 = gradient.iter().zip(&random).map(|(g, r)| g * r).sum();
            for (direction, expected) in [(&gradient, length), (&random, along / size)] {
                let found = slope(var, direction);
                let off = (found - f64::from(expected)).abs();
                assert!(
                    off < 0.03 * f64::from(length),
                    "{name}: {found} instead of {expected}, gradient {length}"
                );
            }
            checked += 1;
        }
        assert!(checked > 20, "{checked}");
    }

    #[test]
    fn a_network_is_at_no_distance_from_itself() {
        let (own, sample) = (network(4), sample());
        let sum = divergence(&own, &sample, &network(4));
        assert_eq!(sum.to_scalar::<f32>().unwrap(), 0.0);
        let gradients = sum.backward().unwrap();
        for (name, var) in own.parameters().trainable() {
            if let Some(gradient) = gradients.get(var.as_tensor()) {
                assert!(flat(gradient).iter().all(|g| *g == 0.0), "{name}");
            }
        }
        let far = divergence(&own, &sample, &network(5));
        assert!(far.to_scalar::<f32>().unwrap() > 0.0);
    }

    /// The anchor's part is added to the loss; without one the loss is as it was.
    #[test]
    fn an_anchor_adds_its_divergence() {
        let (own, reference, sample) = (network(4), network(5), sample());
        let anchor = |weight| {
            let anchor = Anchor {
                reference: &reference,
                weight,
            };
            own.preference(&sample, 2.0, Some(anchor)).unwrap()
        };
        let alone = own.preference(&sample, 2.0, None).unwrap();
        let loss = |found: &Preference| f64::from(found.loss.to_scalar::<f32>().unwrap());
        let (none, some) = (anchor(0.0), anchor(0.5));
        assert_eq!((loss(&alone), alone.sums), (loss(&none), none.sums));
        assert_eq!(alone.entropy, some.entropy);
        assert_eq!(alone.divergence, 0.0);
        let added = loss(&some) - loss(&none);
        assert!(
            (added - 0.5 * some.divergence).abs() < 1e-3 * added,
            "{added}"
        );
        // A move of evenly drawn fields has the greatest entropy; those that stand have one field.
        let most = |target: &Target| match target.bins[0] {
            STANDS => 2f64.ln(),
            _ => BINS.iter().map(|n| (*n as f64).ln()).sum(),
        };
        let most: f64 = sample.targets.iter().map(most).sum();
        assert!(
            alone.entropy > 0.0 && alone.entropy < most,
            "{} {most}",
            alone.entropy
        );
    }
}
