//! The game for JavaScript: the same methods with types that both languages have.
//!
//! Numbers are returned as `Float32Array`, the rest as JSON or strings; errors are thrown as
//! sentences.

use wasm_bindgen::prelude::*;

use crate::{EgoDriver, Game, GameError, Input, MAX_FRAMES, Settings, decode};

/// A drive through a scene.
#[wasm_bindgen(js_name = Game)]
pub struct WebGame {
    game: Game,
}

#[allow(
    clippy::needless_pass_by_value,
    reason = "`map_err` hands errors over by value"
)]
fn sentence(error: GameError) -> JsError {
    JsError::new(&error.to_string())
}

#[wasm_bindgen(js_class = Game)]
impl WebGame {
    /// Opens a scene.
    #[wasm_bindgen(constructor)]
    pub fn open(
        scene: &[u8],
        name: &str,
        weights: &[u8],
        seed: u32,
        density: f64,
    ) -> Result<WebGame, JsError> {
        let settings = Settings {
            seed: u64::from(seed),
            density,
        };
        let game = Game::open(scene, name, weights, settings).map_err(sentence)?;
        Ok(Self { game })
    }

    /// The SHA-256 of a file.
    pub fn checksum(bytes: &[u8]) -> String {
        crate::checksum(bytes)
    }

    /// Drives for a tenth of a second.
    pub fn tick(
        &mut self,
        driver: u8,
        pedal: i8,
        wheel: i8,
        temperature: u8,
        reverse: bool,
    ) -> Result<(), JsError> {
        let driver = EgoDriver::ALL.get(usize::from(driver)).copied();
        let input = Input {
            driver: driver.unwrap_or_default(),
            pedal,
            wheel,
            temperature,
            reverse,
        };
        self.game.tick(input).map_err(sentence)
    }

    /// The inputs of a link, five numbers for each tenth of a second.
    pub fn inputs_of(code: &str) -> Result<Vec<i16>, JsError> {
        let inputs = decode(code, MAX_FRAMES).map_err(sentence)?;
        let numbers = inputs.iter().flat_map(|input| {
            [
                i16::from(input.driver as u8),
                i16::from(input.pedal),
                i16::from(input.wheel),
                i16::from(input.temperature),
                i16::from(input.reverse),
            ]
        });
        Ok(numbers.collect())
    }

    /// The road as JSON.
    pub fn road(&self) -> String {
        self.game.road()
    }

    /// All agents at a moment.
    pub fn numbers(&self, frame: usize) -> Result<Vec<f32>, JsError> {
        self.game.numbers(frame).map_err(sentence)
    }

    /// Possible next motions of agents, one draw for each.
    pub fn fan(&self, draw: u32) -> Vec<f32> {
        let draw = u64::from(draw);
        self.game.fan_numbers(draw..draw + 1)
    }

    /// Path of the ego so far.
    pub fn trail(&self) -> Vec<f32> {
        self.game.trail()
    }

    /// Frames driven so far.
    pub fn driven(&self) -> usize {
        self.game.driven()
    }

    /// Takes the drive back.
    pub fn rewind(&mut self, frame: usize) -> Result<(), JsError> {
        self.game.rewind(frame).map_err(sentence)
    }

    /// Begins eight futures.
    pub fn branch(&mut self, frame: usize) -> Result<(), JsError> {
        self.game.branch(frame).map_err(sentence)
    }

    /// Goes on with them; false once they are done.
    pub fn branch_on(&mut self) -> bool {
        self.game.go_on_branching()
    }

    /// Progress of the eight futures, 0 to 1.
    pub fn branch_progress(&self) -> f64 {
        let progress = self.game.branches().map(crate::Branches::progress);
        progress.map_or(0.0, |(done, all)| done as f64 / all as f64)
    }

    /// Paths of all agents in one of them.
    pub fn branch_numbers(&self, k: usize) -> Vec<f32> {
        self.game.branch_numbers(k)
    }

    /// Comparison of the eight futures, as JSON.
    pub fn branch_table(&self) -> String {
        self.game.branch_table()
    }

    /// Summary of the drive for display, as JSON.
    pub fn summary(&self) -> Result<String, JsError> {
        self.game.summary().map_err(sentence)
    }

    /// Events of the ego so far, as JSON.
    pub fn events(&self) -> String {
        self.game.events_json()
    }

    /// The inputs as a code for a link.
    pub fn code(&self) -> String {
        self.game.code()
    }

    /// Hash that two equal drives share.
    pub fn fingerprint(&self) -> String {
        self.game.fingerprint()
    }
}
