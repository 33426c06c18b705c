// A drive in an address: the scene, the seed, the density and what was asked of the ego. It stands
// after the #, so it is never sent to a server.

/** What the address says; what it does not say is left out. */
export function read(fragment) {
  const words = new URLSearchParams(fragment.replace(/^#/, ''));
  const link = {};
  const number = (name, most) => {
    const value = Number(words.get(name));
    if (words.has(name) && Number.isFinite(value)) link[name] = Math.max(0, Math.min(most, value));
  };
  number('seed', 2 ** 32 - 1);
  number('density', 1);
  for (const name of ['scene', 'drive']) if (words.get(name)) link[name] = words.get(name);
  if (link.seed !== undefined) link.seed = Math.round(link.seed);
  return link;
}

export function write({ scene, seed, density, drive }) {
  const words = new URLSearchParams({ scene, seed, density });
  if (drive) words.set('drive', drive);
  return `#${words}`;
}
