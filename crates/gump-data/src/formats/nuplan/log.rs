//! Queries on a nuPlan log.
//!
//! Logs may have gigabytes; calls read only the rows they return. `scenario` combines them into
//! scenarios. Start with [`Log::open`] and [`Log::events`].
//!
//! All queries are restricted to rows of the merged lidar, which occur at 20 Hz.

use std::collections::BTreeMap;
use std::path::Path;

use gump_geometry::{Pose, dvec2, wrap_angle};
use gump_scene::{AgentKind, EgoState, LaneId, Light, LightState, RoadblockId};
use rusqlite::{Row, params};

use super::Token;
use super::database::{Database, real, token};
use crate::{DataError, Problem};

/// The tables and columns that are asked for.
const SCHEMA: [(&str, &[&str]); 9] = [
    ("log", &["logfile", "map_version"]),
    ("lidar", &["token", "channel"]),
    (
        "lidar_pc",
        &[
            "token",
            "timestamp",
            "ego_pose_token",
            "lidar_token",
            "scene_token",
        ],
    ),
    (
        "ego_pose",
        &[
            "token",
            "x",
            "y",
            "qw",
            "qx",
            "qy",
            "qz",
            "vx",
            "vy",
            "acceleration_x",
            "acceleration_y",
            "epsg",
        ],
    ),
    (
        "lidar_box",
        &[
            "lidar_pc_token",
            "track_token",
            "x",
            "y",
            "yaw",
            "width",
            "length",
            "height",
            "vx",
            "vy",
        ],
    ),
    ("track", &["token", "category_token"]),
    ("category", &["token", "name"]),
    (
        "scene",
        &["token", "name", "goal_ego_pose_token", "roadblock_ids"],
    ),
    ("scenario_tag", &["lidar_pc_token", "type"]),
];

/// Rows of the merged lidar with their ego poses.
const ROWS: &str = "lidar_pc lp
    JOIN lidar ld ON ld.token = lp.lidar_token AND ld.channel = 'MergedPointCloud'";

/// The scenes that scenarios are taken from: without the first two and the last two by name.
const VALID_SCENES: &str = "SELECT token FROM (
        SELECT token, ROW_NUMBER() OVER (ORDER BY name) AS place, COUNT(*) OVER () AS n FROM scene)
    WHERE place >= 3 AND place < n - 1";

/// An open log.
pub struct Log {
    database: Database,
    name: String,
    map_name: String,
}

/// An instant of a log at which a scenario can be based.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    /// Its row; the name of the scenario.
    pub token: Token,
    /// Its time, microseconds since 1970.
    pub time_us: i64,
    /// Its scenario tags, sorted; empty if untagged.
    pub types: Vec<String>,
}

impl Event {
    /// The scenario type that nuPlan counts it as when these types are requested: the last of them
    /// by name, "unknown" if there is none. `None` means all types.
    ///
    /// Source: nuplan-devkit, which takes the largest of the rows that remain after its filter.
    pub fn scenario_type(&self, wanted: Option<&[String]>) -> &str {
        let counts = |kind: &&String| wanted.is_none_or(|wanted| wanted.contains(kind));
        self.types
            .iter()
            .rfind(counts)
            .map_or("unknown", String::as_str)
    }
}

/// Counts of a log's content, to explain why it yields few scenarios or none.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Census {
    /// Rows of the merged lidar.
    pub rows: usize,
    /// Scenes.
    pub scenes: usize,
    /// Rows with at least one tag.
    pub tagged: usize,
    /// Of these, rows outside of the first two and last two scenes.
    pub usable: usize,
    /// Usable rows by type; a row may have several.
    pub types: BTreeMap<String, usize>,
}

/// One row of the merged lidar with the ego's state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LogRow {
    /// Its identity.
    pub token: Token,
    /// The ego, with the time of the row. Steering and yaw rate are not recorded: 0.
    pub ego: EgoState,
}

/// A box of one row, as recorded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LogBox {
    /// Its track.
    pub track: Token,
    /// Its kind.
    pub kind: AgentKind,
    /// Centre and heading, world frame.
    pub pose: Pose,
    /// Length, width and height, metres.
    pub size: [f64; 3],
    /// World-frame velocity, metres per second; NaN where none is recorded. Kinds that do not move
    /// have none by nuPlan's definition: 0.
    pub velocity: [f64; 2],
}

impl Log {
    /// Opens a log and checks that its tables are there.
    ///
    /// # Errors
    /// [`DataError::Missing`], [`DataError::Io`], [`DataError::Sqlite`]; [`DataError::Table`] for a
    /// missing table or column and for a log without rows.
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let database = Database::open(path)?;
        for (table, columns) in SCHEMA {
            database.require(table, columns)?;
        }
        let sql = "SELECT COALESCE(logfile, ''), COALESCE(map_version, '') FROM log LIMIT 1";
        let read = |row: &Row<'_>| Ok((row.get(0)?, row.get(1)?));
        let about: Vec<(String, String)> =
            database.rows("read the name of the log", sql, [], read)?;
        let Some((name, map)) = about.into_iter().next() else {
            return Err(DataError::Table {
                expected: "one row in table log".into(),
                found: "none".into(),
                path: path.into(),
            });
        };
        let map_name = map.trim_end_matches(".gpkg").to_owned();
        Ok(Self {
            database,
            name,
            map_name,
        })
    }

    /// The log's own name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The location whose map it needs, like "us-ma-boston".
    pub fn map_name(&self) -> &str {
        &self.map_name
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.database.path()
    }

    /// EPSG code of the plane that poses are in, if it is recorded.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn epsg(&self) -> Result<Option<i64>, DataError> {
        let sql = "SELECT epsg FROM ego_pose LIMIT 1";
        let codes = self
            .database
            .rows("read the projection", sql, [], |row| row.get(0))?;
        Ok(codes.into_iter().next().flatten())
    }

    /// Instants at which scenarios can be based, in order of time: those with a tag, and with
    /// `untagged` all others too. The first two and last two scenes are left out as in nuPlan,
    /// because they may lack past or future.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn events(&self, untagged: bool) -> Result<Vec<Event>, DataError> {
        let join = if untagged { "LEFT JOIN" } else { "JOIN" };
        let sql = format!(
            "SELECT lp.token, lp.timestamp, st.type FROM {ROWS}
             {join} scenario_tag st ON st.lidar_pc_token = lp.token
             WHERE lp.scene_token IN ({VALID_SCENES})
             ORDER BY lp.timestamp, lp.token, st.type"
        );
        let read = |row: &Row<'_>| Ok((token(row, 0)?, row.get(1)?, row.get(2)?));
        let rows: Vec<(Token, i64, Option<String>)> =
            self.database.rows("list the scenarios", &sql, [], read)?;
        let mut events: Vec<Event> = Vec::new();
        for (token, time_us, kind) in rows {
            match events.last_mut() {
                Some(event) if event.token == token => event.types.extend(kind),
                _ => events.push(Event {
                    token,
                    time_us,
                    types: kind.into_iter().collect(),
                }),
            }
        }
        for event in &mut events {
            event.types.dedup();
        }
        Ok(events)
    }

    /// The instant with this token, tagged or not, in any scene; `None` if there is none.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn event(&self, wanted: Token) -> Result<Option<Event>, DataError> {
        let sql = format!("SELECT lp.timestamp FROM {ROWS} WHERE lp.token = ?1");
        let doing = "look for a scenario";
        let times = self
            .database
            .rows(doing, &sql, [wanted.as_bytes()], |row| row.get(0))?;
        let Some(time_us) = times.into_iter().next() else {
            return Ok(None);
        };
        let sql = "SELECT DISTINCT type FROM scenario_tag WHERE lidar_pc_token = ?1 ORDER BY type";
        let types = self
            .database
            .rows(doing, sql, [wanted.as_bytes()], |row| row.get(0))?;
        Ok(Some(Event {
            token: wanted,
            time_us,
            types,
        }))
    }

    /// Counts the content of the log.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn census(&self) -> Result<Census, DataError> {
        let count = |sql: &str| -> Result<usize, DataError> {
            let counts = self
                .database
                .rows("count rows", sql, [], |row| row.get::<_, i64>(0))?;
            Ok(counts
                .first()
                .map_or(0, |&n| usize::try_from(n).unwrap_or(0)))
        };
        let events = self.events(false)?;
        let mut types = BTreeMap::new();
        for kind in events.iter().flat_map(|event| &event.types) {
            *types.entry(kind.clone()).or_default() += 1;
        }
        Ok(Census {
            rows: count(&format!("SELECT COUNT(*) FROM {ROWS}"))?,
            scenes: count("SELECT COUNT(*) FROM scene")?,
            tagged: count("SELECT COUNT(DISTINCT lidar_pc_token) FROM scenario_tag")?,
            usable: events.len(),
            types,
        })
    }

    /// Rows from `from_us` to `to_us`, both included, in order of time.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn between(&self, from_us: i64, to_us: i64) -> Result<Vec<LogRow>, DataError> {
        let condition = "lp.timestamp >= ?1 AND lp.timestamp <= ?2 ORDER BY lp.timestamp";
        self.ego_rows(condition, params![from_us, to_us])
    }

    /// The last `n` rows before `time_us`, the latest first.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn before(&self, time_us: i64, n: usize) -> Result<Vec<LogRow>, DataError> {
        let condition = "lp.timestamp < ?1 ORDER BY lp.timestamp DESC LIMIT ?2";
        self.ego_rows(condition, params![time_us, count(n)])
    }

    /// The first `n` rows after `time_us`, the earliest first.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn after(&self, time_us: i64, n: usize) -> Result<Vec<LogRow>, DataError> {
        let condition = "lp.timestamp > ?1 ORDER BY lp.timestamp LIMIT ?2";
        self.ego_rows(condition, params![time_us, count(n)])
    }

    fn ego_rows(
        &self,
        condition: &str,
        params: impl rusqlite::Params,
    ) -> Result<Vec<LogRow>, DataError> {
        let sql = format!(
            "SELECT lp.token, lp.timestamp, ep.x, ep.y, ep.qw, ep.qx, ep.qy, ep.qz, ep.vx, ep.vy,
                 ep.acceleration_x, ep.acceleration_y
             FROM {ROWS} JOIN ego_pose ep ON ep.token = lp.ego_pose_token WHERE {condition}"
        );
        self.database
            .rows("read the ego's states", &sql, params, |row| {
                Ok(LogRow {
                    token: token(row, 0)?,
                    ego: EgoState {
                        time_us: row.get(1)?,
                        rear_axle: pose(row, 2)?,
                        velocity: dvec2(real(row, 8)?, real(row, 9)?),
                        acceleration: dvec2(real(row, 10)?, real(row, 11)?),
                        ..EgoState::default()
                    },
                })
            })
    }

    /// The boxes of a row in nuPlan's order: by kind, within a kind as in the table.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn boxes(&self, row: Token) -> Result<Vec<LogBox>, DataError> {
        let sql = "SELECT lb.track_token, c.name, lb.x, lb.y, lb.yaw, lb.length, lb.width,
                lb.height, lb.vx, lb.vy
             FROM lidar_box lb
             JOIN track t ON t.token = lb.track_token
             JOIN category c ON c.token = t.category_token
             WHERE lb.lidar_pc_token = ?1 ORDER BY lb.rowid";
        let read = |row: &Row<'_>| {
            let kind = kind(&row.get::<_, String>(1)?);
            let moving = kind.is_moving();
            Ok(LogBox {
                track: token(row, 0)?,
                kind,
                pose: Pose::new(real(row, 2)?, real(row, 3)?, wrap_angle(real(row, 4)?)),
                size: [real(row, 5)?, real(row, 6)?, real(row, 7)?],
                velocity: if moving {
                    [real(row, 8)?, real(row, 9)?]
                } else {
                    [0.0; 2]
                },
            })
        };
        let mut boxes = self
            .database
            .rows("read the boxes", sql, [row.as_bytes()], read)?;
        boxes.sort_by_key(|b| b.kind);
        Ok(boxes)
    }

    /// The lights of a row, by lane connector.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn lights(&self, row: Token) -> Result<Vec<Light>, DataError> {
        let sql = "SELECT lane_connector_id, status FROM traffic_light_status
             WHERE lidar_pc_token = ?1 ORDER BY rowid";
        self.database
            .rows("read the traffic lights", sql, [row.as_bytes()], |row| {
                let status: Option<String> = row.get(1)?;
                Ok(Light {
                    lane: LaneId(row.get(0)?),
                    state: match status.as_deref() {
                        Some("green") => LightState::Green,
                        Some("yellow") => LightState::Yellow,
                        Some("red") => LightState::Red,
                        _ => LightState::Unknown,
                    },
                    stop_point: None,
                })
            })
    }

    /// The goal of the ego in the row's scene, rear axle; `None` if the scene has none.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn goal(&self, row: Token) -> Result<Option<Pose>, DataError> {
        let sql = "SELECT ep.x, ep.y, ep.qw, ep.qx, ep.qy, ep.qz FROM lidar_pc lp
             JOIN scene s ON s.token = lp.scene_token
             JOIN ego_pose ep ON ep.token = s.goal_ego_pose_token WHERE lp.token = ?1";
        let read = |row: &Row<'_>| pose(row, 0);
        let goals = self
            .database
            .rows("read the goal", sql, [row.as_bytes()], read)?;
        Ok(goals.into_iter().next())
    }

    /// The roadblocks of the ego's route in the row's scene, as stated, with repeats and gaps.
    /// Invalid ids are dropped.
    ///
    /// # Errors
    /// [`DataError::Sqlite`].
    pub fn roadblocks(&self, row: Token) -> Result<Vec<RoadblockId>, DataError> {
        let sql = "SELECT s.roadblock_ids FROM lidar_pc lp
             JOIN scene s ON s.token = lp.scene_token WHERE lp.token = ?1";
        let read = |row: &Row<'_>| row.get::<_, Option<String>>(0);
        let lists = self
            .database
            .rows("read the route", sql, [row.as_bytes()], read)?;
        let text = lists.into_iter().flatten().next().unwrap_or_default();
        let words = text.split(|c: char| c.is_whitespace() || c == ',');
        Ok(words
            .filter_map(|word| word.parse().ok())
            .map(RoadblockId)
            .collect())
    }
}

/// A limit for a query.
fn count(n: usize) -> i64 {
    i64::try_from(n).unwrap_or(i64::MAX)
}

/// A pose from columns x, y, qw, qx, qy, qz; the heading is the quaternion's yaw.
fn pose(row: &Row<'_>, first: usize) -> rusqlite::Result<Pose> {
    let column = |i: usize| real(row, first + i);
    let (w, x, y, z) = (column(2)?, column(3)?, column(4)?, column(5)?);
    let heading = (2.0 * (w * z - x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    Ok(Pose::new(column(0)?, column(1)?, heading))
}

fn kind(category: &str) -> AgentKind {
    match category {
        "vehicle" => AgentKind::Vehicle,
        "pedestrian" => AgentKind::Pedestrian,
        "bicycle" => AgentKind::Bicycle,
        "traffic_cone" => AgentKind::TrafficCone,
        "barrier" => AgentKind::Barrier,
        "czone_sign" => AgentKind::Sign,
        _ => AgentKind::Other,
    }
}

/// Returns the problem for a value of a log that no scenario can be made of.
pub(super) fn unexpected(expected: &'static str, found: String, place: String) -> Problem {
    Problem::Unexpected {
        expected,
        found: found.into(),
        place: place.into(),
    }
}
