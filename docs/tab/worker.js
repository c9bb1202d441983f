// Runs the chain beside the page: one mission, which ends with the worker.
"use strict";

const MAP = 1, DONE = 2, FAILED = 3;

onmessage = async ({ data: { altitude_km, inclination_deg, daughters, frequency_mhz } }) => {
  try {
    const { instance } = await WebAssembly.instantiateStreaming(fetch("lunarray_tab.wasm"));
    const chain = instance.exports;
    const copy = (address, bytes) => chain.memory.buffer.slice(address, address + bytes);
    const text = () => new TextDecoder().decode(copy(chain.text(), chain.text_bytes()));
    let state = chain.start(altitude_km, inclination_deg, daughters, frequency_mhz);
    while (state < DONE) {
      state = chain.step();
      if (state === FAILED) break;
      const shown = { state, ...JSON.parse(text()) };
      if (state === MAP || state === DONE) {
        shown.picture = copy(chain.picture(), chain.picture_bytes());
        shown.map_k = new Float64Array(copy(chain.map(), 8 * chain.map_pixels()));
      }
      postMessage(shown);
    }
    if (state === FAILED) postMessage({ state, error: text() });
  } catch (error) {
    postMessage({ state: FAILED, error: String(error) });
  }
};
