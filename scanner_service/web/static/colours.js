// Colour scales from 0 to 1 and round numbers for their legend; knows no points and no page.

const anchors = (text) => text.split(" ").map((hex) => [0, 2, 4].map((at) => Number.parseInt(hex.slice(at, at + 2), 16)));

// 33 evenly spaced sRGB anchors each. Viridis: S. van der Walt and N. Smith 2015 (CC0). Turbo: A. Mikhailov 2019 (Apache-2.0).
export const SCALES = {
  viridis: {
    text: "viridis",
    anchors: anchors(
      "440154 470d60 48186a 482374 472d7b 453781 424086 3e4989 3b528b 375b8d 33638d 2f6b8e 2c728e 297a8e 26828e 23898e 21918c " +
        "1f988b 1fa088 22a785 28ae80 32b67a 3fbc73 4ec36b 5ec962 70cf57 84d44b 98d83e addc30 c2df23 d8e219 ece51b fde725",
    ),
  },
  turbo: {
    text: "turbo",
    anchors: anchors(
      "30123b 392a73 4040a2 4456c7 466be3 4680f6 4294ff 37a8fa 28bceb 1ccdd8 18ddc2 1fe9af 32f298 4ef97d 6dfe62 8bff4b a4fc3c " +
        "b9f635 cdec34 dfdf37 eecf3a f8be39 fdac34 fe962b fb7e21 f46617 eb500e df3f08 d02f05 be2102 a91601 920b01 7a0403",
    ),
  },
  // blue is dense and red is sparse, as in the literature on laser scanning
  bgyr: { text: "blue dense – red sparse", anchors: anchors("d7191c f0602f fda64a f9e04f c3e356 6cc45f 2fa58a 2b83ba 1f4fb4") },
};

// [r, g, b] of 0-255 at `share`, which is held to 0-1; between two anchors linear.
export function colourAt(scale, share) {
  const list = SCALES[scale].anchors;
  const at = Math.min(1, Math.max(0, share)) * (list.length - 1);
  const low = Math.min(Math.floor(at), list.length - 2);
  return [0, 1, 2].map((channel) => Math.round(list[low][channel] + (at - low) * (list[low + 1][channel] - list[low][channel])));
}

// `size` colours as bytes r g b 255, for a texture.
export function colourTable(scale, size = 256) {
  const table = new Uint8Array(4 * size);
  for (let i = 0; i < size; i += 1) table.set([...colourAt(scale, i / (size - 1)), 255], 4 * i);
  return table;
}

// The smallest of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten that is not below `value`.
export function roundUp(value) {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  const step = [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((candidate) => candidate * power >= value * (1 - 1e-9));
  return Number((step * power).toPrecision(2));
}

// Round numbers between low and high, about `count` of them.
export function ticks(low, high, count = 4) {
  const raw = (high - low) / count;
  if (!(raw > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((candidate) => candidate * power >= raw * 0.999) * power;
  const list = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i += 1) list.push(Number((i * step).toPrecision(12)));
  return list;
}
