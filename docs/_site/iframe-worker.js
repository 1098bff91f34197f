// Browsers start no worker for a page that was opened from a folder; there, search runs in a hidden frame instead.
// (The name iframe-worker is what the theme looks for before it loads such a thing from the network.)
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      this.ready = new Promise((resolve) => { frame.onload = () => resolve(frame.contentWindow) })
      frame.srcdoc = `<script>
        const load = (url) => new Promise((done) => {
          const script = document.createElement("script")
          script.src = url
          script.onload = done
          document.head.append(script)
        })
        importScripts = (...urls) => urls.reduce((before, url) => before.then(() => load(url)), Promise.resolve())
        postMessage = (data) => parent.dispatchEvent(new MessageEvent("frame-message", { data: { from: window, data } }))
      </script><script src="${new URL(url, location.href)}"></script>`
      addEventListener("frame-message", ({ data }) => {
        if (data.from === frame.contentWindow) this.dispatchEvent(new MessageEvent("message", { data: data.data }))
      })
      document.body.append(frame)
    }

    postMessage(data) {
      this.ready.then((frame) => frame.dispatchEvent(new MessageEvent("message", { data })))
    }

    terminate() {}
  }
}
