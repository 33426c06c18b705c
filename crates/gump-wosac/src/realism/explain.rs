//! The largest penalties of a score: component, agent and time.

use gump_scene::{AgentId, AgentKind};

use super::config::Component;
use super::reference::Evaluation;

/// The penalty of one agent in one component.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attribution {
    /// The component.
    pub component: Component,
    /// The agent.
    pub agent: AgentId,
    /// Its kind.
    pub kind: AgentKind,
    /// Its part of the loss of the metametric: the lost weight of the component, split by
    /// log-likelihood. The costs of all agents and components and the metametric add up to the sum
    /// of the weights.
    pub cost: f64,
    /// Geometric mean of the likelihoods of its logged values, 0 to 1.
    pub likelihood: f64,
    /// The scored step with the lowest likelihood, from 0; of an indicator the first at which it
    /// holds, in the log or, if never there, in any rollout. `None` if it holds nowhere.
    pub step: Option<usize>,
    /// The logged value at that step, in the unit of the component; of an indicator whether it ever
    /// holds, as 0 or 1.
    pub logged: f64,
    /// The mean of the rollouts at that step; of an indicator the share in which it ever holds.
    pub imagined: f64,
}

/// The likelihood of the log of one agent under the rollouts.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentRealism {
    /// The agent.
    pub agent: AgentId,
    /// Weighted mean of its likelihoods over its components, 0 to 1.
    pub realism: f64,
    /// Likelihood of the log at each step, from the components that change from step to step;
    /// `None` where none of them counts.
    pub steps: Vec<Option<f64>>,
}

/// A weighted mean under construction.
#[derive(Clone, Copy, Default)]
struct Weighted {
    sum: f64,
    weight: f64,
}

impl Weighted {
    fn add(&mut self, value: f64, weight: f64) {
        self.sum += weight * value;
        self.weight += weight;
    }

    fn mean(self) -> Option<f64> {
        (self.weight > 0.0).then(|| self.sum / self.weight)
    }
}

impl Evaluation<'_> {
    /// The likelihood of the log of each scored agent, with the weights of the year; agents without
    /// any value that counts are left out.
    pub fn realism(&self) -> Vec<AgentRealism> {
        let features = self.reference.features();
        let (n, n_steps) = (features.agents.len(), features.n_steps);
        let mut whole = vec![Weighted::default(); n];
        let mut steps = vec![Weighted::default(); n * n_steps];
        for (component, feature) in self.reference.config.components() {
            let weight = f64::from(feature.weight);
            for attribution in self.attributions(component) {
                let own = features
                    .agents
                    .iter()
                    .position(|id| *id == attribution.agent);
                if let Some(agent) = own {
                    whole[agent].add(attribution.likelihood, weight);
                }
            }
            if component.is_indication() {
                continue;
            }
            let found = self.log_likelihoods[&component].iter();
            let counted = found.zip(self.reference.mask(component)).zip(&mut steps);
            for ((likelihood, counts), mean) in counted {
                if counts {
                    mean.add(f64::from(*likelihood).exp(), weight);
                }
            }
        }
        let of_agent = |agent: usize| {
            let steps = steps[agent * n_steps..][..n_steps].iter();
            Some(AgentRealism {
                agent: features.agents[agent],
                realism: whole[agent].mean()?,
                steps: steps.map(|mean| mean.mean()).collect(),
            })
        };
        (0..n).filter_map(of_agent).collect()
    }

    /// The penalty of each agent in each component, largest first; zero penalties are left out.
    pub fn explain(&self) -> Vec<Attribution> {
        let config = self.reference.config;
        let mut attributions: Vec<Attribution> = config
            .components()
            .flat_map(|(component, feature)| {
                let weight = f64::from(feature.weight);
                self.attributions(component)
                    .into_iter()
                    .map(move |attribution| Attribution {
                        cost: attribution.cost * weight,
                        ..attribution
                    })
            })
            .filter(|attribution| attribution.cost > 0.0)
            .collect();
        attributions.sort_by(|a, b| b.cost.total_cmp(&a.cost));
        attributions
    }

    /// Costs in terms of the component's own likelihood.
    fn attributions(&self, component: Component) -> Vec<Attribution> {
        let features = self.reference.features();
        let found = &self.log_likelihoods[&component];
        let (n_steps, mask) = if component.is_indication() {
            (1, vec![true; found.len()])
        } else {
            (features.n_steps, self.reference.mask(component))
        };
        let counted = mask.iter().filter(|&&counts| counts).count() as f64;
        let sum_over = |agents: std::ops::Range<usize>| {
            let steps = agents.start * n_steps..agents.end * n_steps;
            let values = steps.clone().filter(|&i| mask[i]);
            let n = values.clone().count() as f64;
            (values.map(|i| f64::from(found[i])).sum::<f64>(), n)
        };
        let (total, _) = sum_over(0..features.agents.len());
        let likelihood = (total / counted).exp();
        (0..features.agents.len())
            .filter_map(|agent| {
                let (own, n) = sum_over(agent..agent + 1);
                if n == 0.0 {
                    return None;
                }
                let (step, logged, imagined) = if component.is_indication() {
                    self.when_indicated(component, agent)
                } else {
                    let steps = (agent * n_steps..(agent + 1) * n_steps).filter(|&i| mask[i]);
                    let worst = steps.min_by(|&a, &b| found[a].total_cmp(&found[b]))?;
                    let imagined = self.imagined.iter().map(|f| f.values(component)[worst]);
                    let logged = features.values(component)[worst];
                    (Some(worst % n_steps), f64::from(logged), mean(imagined))
                };
                Some(Attribution {
                    component,
                    agent: features.agents[agent],
                    kind: features.kinds[agent],
                    cost: if own == 0.0 {
                        0.0
                    } else {
                        (1.0 - likelihood) * own / total
                    },
                    likelihood: (own / n).exp(),
                    step,
                    logged,
                    imagined,
                })
            })
            .collect()
    }

    /// The first step at which an indicator holds, whether it holds in the log, and its share of
    /// rollouts.
    fn when_indicated(&self, component: Component, agent: usize) -> (Option<usize>, f64, f64) {
        let vehicles_only = component == Component::TrafficLightViolation;
        let first = |features| {
            let holds = self.reference.indicated(features, component, vehicles_only);
            let n_steps = holds.len() / self.reference.features().agents.len();
            holds[agent * n_steps..][..n_steps]
                .iter()
                .position(|&holds| holds)
        };
        let logged = first(self.reference.features());
        let imagined: Vec<_> = self.imagined.iter().map(first).collect();
        let step = logged.or_else(|| imagined.iter().flatten().min().copied());
        let share = mean(
            imagined
                .iter()
                .map(|step| f32::from(u8::from(step.is_some()))),
        );
        (step, f64::from(u8::from(logged.is_some())), share)
    }
}

/// The mean of the finite values.
fn mean(values: impl Iterator<Item = f32>) -> f64 {
    let values = values.filter(|value| !value.is_nan());
    let (sum, n) = values.fold((0.0, 0.0), |(sum, n), v| (sum + f64::from(v), n + 1.0));
    sum / n
}
