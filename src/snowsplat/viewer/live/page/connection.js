// The connection to the server: messages in both directions, and images. It reconnects by itself.

const FIRST_PAUSE = 500; // milliseconds before it reconnects; twice as many after each failure
const LONGEST_PAUSE = 10000;

/**
 * @typedef {object} Receiver
 * @property {() => void} opened
 * @property {() => void} closed
 * @property {(message: any) => void} told
 * @property {(image: {number: number, view: number, blob: Blob}) => void} image
 * @property {(thumbnail: {index: number, blob: Blob}) => void} thumbnail
 */

export class Connection {
    /** @param {Receiver} receiver */
    constructor(receiver) {
        this.receiver = receiver;
        this.pause = FIRST_PAUSE;
        this.socket = this.connect();
        addEventListener("online", () => this.retry());
        document.addEventListener("visibilitychange", () => this.retry());
    }

    connect() {
        const url = new URL("live", location.href);
        url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
        const socket = new WebSocket(url);
        socket.binaryType = "arraybuffer";
        socket.onopen = () => {
            this.pause = FIRST_PAUSE;
            this.receiver.opened();
        };
        socket.onmessage = ({ data }) => {
            if (typeof data === "string") this.receiver.told(JSON.parse(data));
            else this.receive(data);
        };
        socket.onclose = () => {
            this.receiver.closed();
            this.timer = setTimeout(() => (this.socket = this.connect()), this.pause);
            this.pause = Math.min(2 * this.pause, LONGEST_PAUSE);
        };
        return socket;
    }

    /** Reconnect at once, if it waits to do so. */
    retry() {
        if (document.hidden || this.socket.readyState !== WebSocket.CLOSED) return;
        clearTimeout(this.timer);
        this.socket = this.connect();
    }

    /** Before a JPEG: its kind; its number and that of its view, or the index of the photo. @param {ArrayBuffer} data */
    receive(data) {
        const head = new DataView(data, 0, 12);
        const blob = new Blob([new Uint8Array(data, 12)], { type: "image/jpeg" });
        const [number, view] = [head.getUint32(4, true), head.getUint32(8, true)];
        if (head.getUint8(0) === 0) this.receiver.image({ number, view, blob });
        else this.receiver.thumbnail({ index: number, blob });
    }

    /** @param {object} message */
    send(message) {
        if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
    }
}
