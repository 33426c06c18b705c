// Talks with the worker that holds the engine: a promise for every question.

export class Engine {
  constructor() {
    this.waiting = new Map();
    this.n = 0;
    this.worker = new Worker('./worker.js', { type: 'module' });
    this.worker.onmessage = ({ data }) => {
      const asked = this.waiting.get(data.id);
      this.waiting.delete(data.id);
      if (!asked) return;
      if (data.error === undefined) asked.resolve(data.result);
      else asked.reject(new Error(data.broken ? `The engine has stopped (${data.error}). Load the page again.` : data.error));
    };
    // A worker that does not even load says nothing more than that.
    this.worker.onerror = event => {
      const sentence = 'The engine could not be loaded: a file of this page is missing or the browser is too old for module workers.';
      const error = new Error(event.message ? `${sentence} (${event.message})` : sentence);
      // It may fail before anything has been asked.
      this.dead = error;
      for (const { reject } of this.waiting.values()) reject(error);
      this.waiting.clear();
    };
  }

  ask(what, needs = {}) {
    if (this.dead) return Promise.reject(this.dead);
    this.n += 1;
    const id = this.n;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      this.worker.postMessage({ id, what, ...needs });
    });
  }
}
