//! One mission, from the sky to the last map.

use lunarray_app::pipeline::{Plan, StepwiseRun};
use lunarray_core::imaging::Solution;
use lunarray_core::products::pictures::{
    Bars, ColourScale, MapPanel, Palette, Sampling, Scaling, Sheet, View, draw_sheet,
};
use lunarray_core::runtime::BoxError;
use lunarray_core::sky::{Comparison, Frame, SkyMap, compare};
use serde_json::json;

use crate::settings::Sliders;

/// Width of the pictures, pixels.
const WIDTH_PX: usize = 900;

/// A mission that is flown in steps, and what it has shown last.
pub struct Session {
    sliders: Sliders,
    plan: Plan,
    run: StepwiseRun,
    /// The sky to the degrees of the map.
    sky: SkyMap,
    map_k: Vec<f64>,
    picture: Vec<u8>,
    last: Option<(Solution, Comparison)>,
}

impl Session {
    /// Makes the sky and the array.
    ///
    /// # Errors
    /// Settings that the pipeline refuses.
    pub fn new(sliders: &Sliders) -> Result<Self, BoxError> {
        let plan = Plan::new(sliders.config()?)?;
        let run = StepwiseRun::new(&plan)?;
        let shape = plan.config.map_shape();
        let observed = run.skies().first().ok_or("no channel; expected one")?;
        let sky = match shape.l_max {
            Some(l_max) => observed.band_limited(shape.nside, l_max)?,
            None => observed.to_ecliptic().resized(shape.nside)?,
        };
        Ok(Self { sliders: *sliders, plan, run, sky, map_k: Vec::new(), picture: Vec::new(), last: None })
    }

    /// Observes one more window; whether there is a new map.
    ///
    /// # Errors
    /// The error of a stage.
    pub fn step(&mut self) -> Result<bool, BoxError> {
        let Some(solution) = self.run.step()?.pop() else { return Ok(false) };
        let map = SkyMap::new(Frame::Ecliptic, solution.map_k.clone())?;
        let noise = SkyMap::new(Frame::Ecliptic, solution.noise_k.clone())?;
        let observed = self.run.skies().first().ok_or("no channel; expected one")?;
        let comparison = compare(&map, observed, Some(&noise), None)?;
        self.map_k = map.into_values();
        self.picture = self.draw()?;
        self.last = Some((solution, comparison));
        Ok(true)
    }

    /// Whether the last map is there.
    #[must_use]
    pub fn is_done(&self) -> bool {
        self.run.is_done()
    }

    /// The last map, K.
    #[must_use]
    pub fn map_k(&self) -> &[f64] {
        &self.map_k
    }

    /// Map and sky as PNG.
    #[must_use]
    pub fn picture(&self) -> &[u8] {
        &self.picture
    }

    /// Settings, progress and figures of the last map as JSON.
    #[must_use]
    pub fn describe(&self) -> String {
        let spacecraft = &self.plan.config.spacecraft;
        let [windows, windows_all] = self.run.windows();
        let mut text = json!({
            "windows": windows,
            "windows_all": windows_all,
            "every_nth_window": spacecraft.every_nth_window,
            "every_nth_integration": spacecraft.every_nth_integration,
            "downlink_bytes": self.run.downlink_bytes(),
            "nside": self.plan.config.map.nside,
            "sky_nside": self.plan.config.sky.nside,
            "duration_s": spacecraft.duration_s,
            "keys": self.sliders.overrides(),
            "orbital_period_s": self.plan.config.array.orbital_period_s,
        });
        if let Some((solution, comparison)) = &self.last {
            text["map"] = json!({
                "number": solution.number,
                "is_final": solution.is_final,
                "span_s": solution.span_s,
                "visibilities": solution.visibilities,
                "mean_k": mean(&solution.map_k),
                "sky_mean_k": mean(self.sky.values()),
                "rho": comparison.rho,
                "snr": comparison.snr,
            });
        }
        text.to_string()
    }

    fn draw(&self) -> Result<Vec<u8>, BoxError> {
        // Both with the scale of the sky, so that maps can be compared as they sharpen.
        let scale = ColourScale::robust(self.sky.values(), Scaling::Log, Palette::Inferno);
        let panel = |values, caption: &str| MapPanel {
            values,
            caption: caption.to_owned(),
            scale,
            unit: "K".to_owned(),
        };
        let panels = [panel(&self.map_k, "Map"), panel(self.sky.values(), "Sky, to the degrees of the map")];
        let view = View {
            sampling: Sampling::Interpolated,
            centre_deg: 0.0,
            ..View::of(Frame::Galactic, Frame::Ecliptic)
        };
        let sheet = Sheet { columns: 1, width_px: WIDTH_PX, bars: Bars::Shared, view, ..Sheet::default() };
        Ok(draw_sheet(&panels, &sheet)?.to_png()?)
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}
