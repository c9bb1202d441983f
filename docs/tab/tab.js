// The sliders, the worker that flies the mission, and what it shows.
"use strict";
(() => {
  const form = document.getElementById("tab");
  const sliders = [...form.querySelectorAll("input")];
  const at = (name) => document.getElementById(`tab-${name}`);
  const folder = new URL(".", document.currentScript.src);
  const seen = (window.lunarrayTab = { maps: [] }); // For programs that look.
  let worker = null;

  const label = (slider) => {
    slider.parentElement.querySelector("output").textContent = `${slider.value} ${slider.dataset.unit}`;
  };
  sliders.forEach((slider) => {
    label(slider);
    slider.addEventListener("input", () => label(slider));
  });

  const number = (value, digits) => (value === null ? "–" : value.toFixed(digits));
  const kelvin = (value) => `${Math.round(value).toLocaleString("en")} K`;
  const figures = (rows) => {
    at("figures").replaceChildren(...rows.map((cells) => {
      const row = document.createElement("tr");
      row.append(...cells.map((cell, k) => {
        const found = document.createElement(k ? "td" : "th");
        found.textContent = cell;
        return found;
      }));
      return row;
    }));
  };

  const show = (found, since) => {
    const seconds = (performance.now() - since) / 1000;
    if (found.error !== undefined) {
      at("status").textContent = `Failed: ${found.error}`;
      seen.error = found.error;
      return;
    }
    const { windows, windows_all, map } = found;
    form.querySelector("progress").value = windows / windows_all;
    const end = found.state === 2 ? "Done" : "Flying";
    at("status").textContent = `${end}: window ${windows} of ${windows_all}, ` +
      `${(found.downlink_bytes / 1e6).toFixed(2)} MB sent down, ${seconds.toFixed(0)} s.`;
    at("thinned").textContent = `Thinned: every ${found.every_nth_window}th window of ` +
      `${(found.duration_s / 86400).toFixed(0)} days and every ${found.every_nth_integration}th integration. ` +
      `Map: nside ${found.nside}; sky: nside ${found.sky_nside}; one orbit takes ${(found.orbital_period_s / 60).toFixed(1)} min.`;
    if (!found.picture) return;
    seen.maps.push({ seconds, ...found });
    const before = at("picture").src;
    at("picture").src = URL.createObjectURL(new Blob([found.picture], { type: "image/png" }));
    at("picture").alt = "The map so far, above the sky that it should show";
    if (before) URL.revokeObjectURL(before);
    const degrees = [2, 4, 6, 8, 10, 12, 14, 16];
    figures([
      ["Degree l", ...degrees],
      ["ρ_l with the sky", ...degrees.map((l) => number(map.rho[l], 3))],
      ["Signal to noise", ...degrees.map((l) => number(map.snr[l], 1))],
    ]);
    at("status").textContent += ` Map ${map.number}${map.is_final ? ", the last" : ""}: ` +
      `${map.visibilities.toLocaleString("en")} visibilities, mean ${kelvin(map.mean_k)} (sky ${kelvin(map.sky_mean_k)}).`;
    at("keys").textContent = found.state === 2 ? found.keys.map((key) => `--set ${key}`).join("\n") : "";
  };

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    worker?.terminate();
    [seen.maps, seen.error] = [[], undefined];
    at("figures").replaceChildren();
    at("keys").textContent = "";
    at("status").textContent = "Loading.";
    worker = new Worker(new URL("worker.js", folder));
    const since = performance.now();
    worker.onmessage = ({ data }) => show(data, since);
    worker.onerror = (error) => show({ error: error.message }, since);
    worker.postMessage(Object.fromEntries(sliders.map((slider) => [slider.name, Number(slider.value)])));
  });
})();
