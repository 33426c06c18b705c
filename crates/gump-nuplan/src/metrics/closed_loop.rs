//! All closed-loop metrics of one drive.

use gump_geometry::DVec2;
use gump_scene::{EgoState, LaneId};

use super::collision::{Collisions, collisions};
use super::comfort::ComfortSeries;
use super::drivable_area::{DrivableArea, drivable_area};
use super::driving_direction::{DrivingDirection, DrivingDirectionConfig, driving_direction};
use super::lanes::{
    CornerLanes, Keeping, LaneChange, corner_lanes, followed_lanes, is_in_intersection, keeping,
    lane_changes,
};
use super::progress::{ExpertProgress, expert_progress};
use super::scoring::{MetricScores, Scoring};
use super::speed_limit::{SpeedLimit, speed_limit};
use super::time_to_collision::{
    RoadContext, TimeToCollision, TimeToCollisionConfig, time_to_collision,
};
use super::{NuPlanError, SimulationHistory};
use gump_metrics::ComfortBounds;

/// nuPlan's closed-loop metrics of one drive. All series have one entry per sample.
#[derive(Clone, Debug, PartialEq)]
pub struct ClosedLoop {
    /// `no_ego_at_fault_collisions`.
    pub collisions: Collisions,
    /// `drivable_area_compliance`.
    pub drivable_area: DrivableArea,
    /// `driving_direction_compliance`.
    pub driving_direction: DrivingDirection,
    /// `ego_progress_along_expert_route`, and from it `ego_is_making_progress`.
    pub progress: ExpertProgress,
    /// `time_to_collision_within_bound`.
    pub time_to_collision: TimeToCollision,
    /// `speed_limit_compliance`.
    pub speed_limit: SpeedLimit,
    /// The series of `ego_is_comfortable`; `None` for drives of fewer than four samples.
    pub comfort: Option<ComfortSeries>,
    /// `ego_lane_change`, a statistic.
    pub lane_changes: Vec<LaneChange>,
    /// The lanes under the ego's centre.
    pub followed: Vec<Vec<LaneId>>,
    /// The lanes under its corners, from front left counter-clockwise.
    pub corners: Vec<[Vec<LaneId>; 4]>,
    /// The relations of those lanes.
    pub keeping: Vec<Keeping>,
}

/// Measures a drive with every closed-loop metric.
///
/// On maps derived from other datasets, lanes without outlines have their stated width, the border
/// of the road is that of [`gump_metrics::metres_off_road`], progress is measured along the
/// expert's own path, and unknown limits and borders are not violated.
///
/// # Errors
/// [`NuPlanError`] if samples or expert are missing, not finite or not in order of time.
///
/// Source: nuplan-devkit, the metrics of its closed-loop challenges with their parameters.
pub fn score(drive: &SimulationHistory<'_>) -> Result<ClosedLoop, NuPlanError> {
    check(drive)?;
    let boxes: Vec<[DVec2; 4]> = drive
        .samples
        .iter()
        .map(|sample| drive.footprint(sample).corners())
        .collect();
    let followed = followed_lanes(drive.map, &drive.centres());
    let corners = corner_lanes(drive.map, &boxes);
    let keeping = judged(&corners);
    let in_one_lane: Vec<bool> = keeping.iter().map(Keeping::is_within).collect();
    let contexts: Vec<RoadContext> = drive
        .samples
        .iter()
        .zip(&in_one_lane)
        .map(|(sample, &in_one_lane)| RoadContext {
            in_one_lane,
            in_intersection: is_in_intersection(drive.map, sample.ego.rear_axle.position),
        })
        .collect();
    let collisions = collisions(drive, &in_one_lane);
    let ids = |lanes: &Vec<&gump_scene::Lane>| lanes.iter().map(|lane| lane.id).collect();
    Ok(ClosedLoop {
        drivable_area: drivable_area(drive, &followed, &corners),
        driving_direction: driving_direction(drive, &followed, &DrivingDirectionConfig::default()),
        progress: expert_progress(drive),
        time_to_collision: time_to_collision(
            drive,
            &contexts,
            &collisions,
            &TimeToCollisionConfig::default(),
        ),
        speed_limit: speed_limit(drive, &followed),
        comfort: ComfortSeries::of(&drive.motion()),
        lane_changes: lane_changes(drive.map, &keeping),
        followed: followed.iter().map(ids).collect(),
        corners: corners.iter().map(|c| c.each_ref().map(ids)).collect(),
        collisions,
        keeping,
    })
}

impl ClosedLoop {
    /// 1 if the drive is comfortable, 0 if not; `None` if it is too short.
    pub fn comfort_score(&self) -> Option<f64> {
        let series = self.comfort.as_ref()?;
        Some(f64::from(series.is_comfortable(&ComfortBounds::NUPLAN)))
    }

    /// The scores by nuPlan's names, as input of [`Scoring`].
    pub fn scores(&self) -> MetricScores {
        let named = [
            ("no_ego_at_fault_collisions", Some(self.collisions.score)),
            ("drivable_area_compliance", Some(self.drivable_area.score)),
            (
                "driving_direction_compliance",
                Some(self.driving_direction.score),
            ),
            (
                "ego_is_making_progress",
                Some(self.progress.making_progress()),
            ),
            ("ego_progress_along_expert_route", Some(self.progress.ratio)),
            (
                "time_to_collision_within_bound",
                Some(self.time_to_collision.score),
            ),
            ("speed_limit_compliance", Some(self.speed_limit.score)),
            ("ego_is_comfortable", self.comfort_score()),
        ];
        let owned = named.into_iter().map(|(name, s)| (name.to_owned(), s));
        owned.collect()
    }

    /// One number, usually by [`Scoring::closed_loop`].
    pub fn score(&self, scoring: &Scoring) -> f64 {
        scoring.score(&self.scores())
    }
}

/// The relation of the corners' lanes, evaluated again only when the lanes change.
fn judged(corners: &[CornerLanes<'_>]) -> Vec<Keeping> {
    let same = |a: &CornerLanes<'_>, b: &CornerLanes<'_>| {
        let ids = |c: &CornerLanes<'_>| c.each_ref().map(|l| l.iter().map(|l| l.id).collect());
        let (a, b): ([Vec<LaneId>; 4], [Vec<LaneId>; 4]) = (ids(a), ids(b));
        a == b
    };
    let mut judged: Vec<Keeping> = Vec::with_capacity(corners.len());
    for (i, lanes) in corners.iter().enumerate() {
        let unchanged = i > 0 && same(&corners[i - 1], lanes);
        let now = if unchanged {
            judged[i - 1].clone()
        } else {
            keeping(lanes)
        };
        judged.push(now);
    }
    judged
}

fn check(drive: &SimulationHistory<'_>) -> Result<(), NuPlanError> {
    if drive.samples.is_empty() {
        return Err(NuPlanError::NoSamples);
    }
    if drive.expert.is_empty() {
        return Err(NuPlanError::NoExpert);
    }
    check_states("the ego", drive.samples.iter().map(|s| &s.ego))?;
    check_states("the expert", drive.expert.iter())
}

fn check_states<'a>(
    who: &'static str,
    states: impl Iterator<Item = &'a EgoState>,
) -> Result<(), NuPlanError> {
    let mut before = None;
    for (index, state) in states.enumerate() {
        if !state.is_finite() {
            return Err(NuPlanError::NotFinite { who, index });
        }
        if before.is_some_and(|before| state.time_us <= before) {
            return Err(NuPlanError::TimeOrder { who, index });
        }
        before = Some(state.time_us);
    }
    Ok(())
}
