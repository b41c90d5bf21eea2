// A page opened from a folder may not start a worker, and the search is one: there it runs in a
// hidden frame of the page instead. On a server the browser's own Worker stays as it is.
if (location.protocol === "file:") {
  window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.documentElement.append(this.frame);
      const inner = this.frame.contentWindow;
      inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      inner.importScripts = async (...urls) => {
        for (const one of urls) await load(inner.document, one);
      };
      this.loaded = load(inner.document, String(url));
    }

    postMessage(data) {
      const told = () =>
        this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data }));
      this.loaded.then(told);
    }

    terminate() {
      this.frame.remove();
    }
  };
  window.Worker = window.IFrameWorker;

  function load(inside, url) {
    return new Promise((done, failed) => {
      const script = inside.createElement("script");
      Object.assign(script, { src: url, onload: done, onerror: failed });
      inside.documentElement.append(script);
    });
  }
}
