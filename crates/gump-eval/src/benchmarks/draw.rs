//! Draws a list from a larger one: at random, or by the scores of planners in its scenes.

use std::collections::BTreeMap;

use gump_scene::Seed;
use rand::Rng as _;

use super::{BenchmarkList, GeneratedPart, RecordedPart};
use crate::datasets::Split;
use crate::{BenchmarkError, EvalError};

/// The choice of scenes for a new list.
#[derive(Clone, Debug)]
pub struct ListDraw<'a> {
    /// The name of the new list.
    pub name: String,
    /// The scenes that may be drawn.
    pub rule: DrawRule<'a>,
    /// Number of scenes of each split at most.
    pub at_most: usize,
    /// The seed of the choice.
    pub seed: Seed,
}

/// The scenes that may be drawn.
#[derive(Clone, Copy, Debug)]
pub enum DrawRule<'a> {
    /// All of them.
    Any,
    /// Those whose worst score is below a bound; scores by the ids of scenes.
    Below(f64, &'a BTreeMap<String, f64>),
}

impl ListDraw<'_> {
    /// The scenes of `list` that are drawn, in their order.
    ///
    /// # Errors
    /// [`BenchmarkError::DrawWithoutChecksums`], or [`BenchmarkError::NothingToDraw`].
    pub fn of(&self, list: &BenchmarkList) -> Result<BenchmarkList, EvalError> {
        let mut drawn: BTreeMap<Split, Vec<(u64, usize, usize)>> = BTreeMap::new();
        let generated = list.generated.iter().map(|part| (part.split, &part.scenes));
        let recorded = list.recorded.iter().map(|part| (part.split, &part.scenes));
        for (p, (split, scenes)) in generated.chain(recorded).enumerate() {
            if scenes.is_empty() {
                let name = list.name.clone();
                return Err(BenchmarkError::DrawWithoutChecksums { name }.into());
            }
            for (i, scene) in scenes.iter().enumerate() {
                let id = scene.rsplit(' ').next().unwrap_or_default();
                if self.rule.admits(id) {
                    // A random rank that does not depend on the other scenes that may be drawn.
                    let rank = self.seed.fork(p as u64).fork(i as u64).rng().random();
                    drawn.entry(split).or_default().push((rank, p, i));
                }
            }
        }
        if drawn.is_empty() {
            let name = list.name.clone();
            return Err(BenchmarkError::NothingToDraw { name }.into());
        }
        for scenes in drawn.values_mut() {
            scenes.sort_unstable();
            scenes.truncate(self.at_most);
        }
        let of_part = |p: usize| {
            let all = drawn.values().flatten();
            let mut kept: Vec<usize> = all.filter(|s| s.1 == p).map(|s| s.2).collect();
            kept.sort_unstable();
            kept
        };
        let generated = list.generated.iter().enumerate().map(|(p, part)| {
            let kept = of_part(p);
            GeneratedPart {
                scenes: kept.iter().map(|&i| part.scenes[i].clone()).collect(),
                keep: kept
                    .iter()
                    .map(|&i| part.keep.get(i).copied().unwrap_or(i))
                    .collect(),
                ..part.clone()
            }
        });
        let recorded = list.recorded.iter().enumerate().map(|(p, part)| {
            let kept = of_part(list.generated.len() + p);
            RecordedPart {
                scenes: kept.iter().map(|&i| part.scenes[i].clone()).collect(),
                ..part.clone()
            }
        });
        let mut drawn_list = list.clone();
        drawn_list.name.clone_from(&self.name);
        drawn_list.about = format!("{} {}", list.about, self.rule.sentence(&list.name));
        drawn_list.generated = generated.filter(|part| !part.keep.is_empty()).collect();
        drawn_list.recorded = recorded.filter(|part| !part.scenes.is_empty()).collect();
        Ok(drawn_list)
    }
}

impl DrawRule<'_> {
    fn admits(&self, id: &str) -> bool {
        match self {
            Self::Any => true,
            Self::Below(bound, worst) => worst.get(id).is_some_and(|score| score < bound),
        }
    }

    fn sentence(&self, from: &str) -> String {
        match self {
            Self::Any => format!("Drawn from {from} by chance."),
            Self::Below(bound, _) => format!(
                "Drawn from {from} by chance among the scenes in which a planner of a report scored \
                 below {bound} in some world."
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pool() -> BenchmarkList {
        let part = |file: &str, split: &str, seed: u64| {
            let scenes: Vec<String> = (0..6).map(|i| format!("\"s{i} {file}-{i}\"")).collect();
            format!(
                "[[made]]\nfile = \"{file}\"\nsplit = \"{split}\"\ngenerator = \"procedural/1\"\n\
                 seed = {seed}\ncount = 6\ndensity = 3.0\nscenes = [{}]\n",
                scenes.join(", ")
            )
        };
        let text = format!(
            "name = \"pool\"\nabout = \"Roads.\"\n{}{}",
            part("a", "tune", 900_000_101),
            part("b", "test", 900_000_102)
        );
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pool.toml");
        std::fs::write(&path, text).unwrap();
        BenchmarkList::read(&path).unwrap()
    }

    fn draw(rule: DrawRule<'_>, at_most: usize, seed: u64) -> Result<BenchmarkList, EvalError> {
        let name = "drawn".into();
        let seed = Seed(seed);
        let draw = ListDraw {
            name,
            rule,
            at_most,
            seed,
        };
        draw.of(&pool())
    }

    #[test]
    fn scenes_below_the_bound_are_kept_with_their_sums_and_places() {
        let worst = [("a-1", 0.5), ("a-4", 0.95), ("b-0", 0.0), ("b-5", 0.89)];
        let worst = worst.map(|(id, score)| (id.to_owned(), score)).into();
        let list = draw(DrawRule::Below(0.9, &worst), 10, 0).unwrap();
        let parts: Vec<_> = list
            .generated
            .iter()
            .map(|p| (&p.keep[..], &p.scenes[..]))
            .collect();
        assert_eq!(parts.len(), 2);
        assert_eq!(
            (parts[0].0, parts[0].1),
            (&[1][..], &["s1 a-1".to_owned()][..])
        );
        assert_eq!(parts[1].0, [0, 5]);
        assert!(list.about.contains("below 0.9"), "{}", list.about);
        // It reads back as it was written.
        let text = toml::to_string_pretty(&list).unwrap();
        let again: BenchmarkList = toml::from_str(&text).unwrap();
        assert_eq!(again.generated[1].keep, [0, 5]);
        assert!(draw(DrawRule::Below(-1.0, &worst), 10, 0).is_err());
    }

    #[test]
    fn a_draw_by_chance_has_so_many_of_every_split_and_depends_on_the_seed() {
        let kept = |seed: u64| -> Vec<Vec<usize>> {
            let list = draw(DrawRule::Any, 3, seed).unwrap();
            list.generated.into_iter().map(|part| part.keep).collect()
        };
        let all: Vec<_> = (0..8).map(kept).collect();
        assert!(
            all.iter()
                .flatten()
                .all(|keep| keep.len() == 3 && keep.is_sorted())
        );
        assert_eq!(kept(3), all[3]);
        assert!(all.iter().any(|keep| *keep != all[0]));
    }
}
