// Requests of the page to its own server only.

export class Refused extends Error {}

const answered = async (response) => {
  const value = await response.json();
  if (!response.ok) throw new Refused(value.error ?? response.statusText);
  return value;
};

export const get = async (path, query = {}) =>
  answered(await fetch(`${path}?${new URLSearchParams(query)}`));

export const act = async (what, about) =>
  answered(
    await fetch(`/${what}`, {
      method: "POST",
      headers: { "Content-Type": "application/json", "X-Dwell-Act": what },
      body: JSON.stringify(about),
    }),
  );

/** Run one call of a function at a time; of the calls made during it, only the last follows. */
export const latest = (call, failed) => {
  let busy = false;
  let next = null;
  return async (...words) => {
    next = words;
    if (busy) return;
    busy = true;
    while (next !== null) {
      const now = next;
      next = null;
      try {
        await call(...now);
      } catch (error) {
        failed(error);
      }
    }
    busy = false;
  };
};
