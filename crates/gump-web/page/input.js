// Hands: keys, a gamepad, a wheel and pedals on a touch screen. Out come a pedal and a wheel, each
// from -1 to 1, the wheel positive to the left, and a gear.

const KEYS = {
  ArrowUp: 'gas', KeyW: 'gas', ArrowDown: 'brake', KeyS: 'brake',
  ArrowLeft: 'left', KeyA: 'left', ArrowRight: 'right', KeyD: 'right',
};
/** Shares of the whole way that a key turns the wheel in a second, and that it comes back by. */
const TURN = 1.8;
const BACK = 3.2;
/** Shares of the whole way that a key presses a pedal in a second. */
const PRESS = 4;
const DEAD = 0.12;
/** A car that is slower than this stands, metres per second. */
const STANDS = 0.05;

export class Hands {
  constructor(touch) {
    this.down = new Set();
    this.wheel = 0;
    this.pedal = 0;
    this.touch = { wheel: null, gas: false, brake: false };
    this.reverse = false;
    this.braked = false;
    /** Whether anything has been touched since it was last asked. */
    this.stirred = false;
    addEventListener('keydown', event => this.key(event, true));
    addEventListener('keyup', event => this.key(event, false));
    addEventListener('blur', () => this.down.clear());
    this.listen(touch);
  }

  key(event, down) {
    const name = KEYS[event.code];
    const typing = event.target instanceof Element && event.target.matches('input[type=number]');
    if (!name || typing || event.ctrlKey || event.metaKey || event.altKey) return;
    if (down) this.down.add(name);
    else this.down.delete(name);
    this.stirred ||= down;
    event.preventDefault();
  }

  listen({ wheel, gas, brake }) {
    const turn = event => {
      const box = wheel.getBoundingClientRect();
      const x = (event.clientX - box.left - box.width / 2) / (box.width * 0.6);
      this.touch.wheel = Math.max(-1, Math.min(1, -x));
      wheel.firstElementChild.style.transform = `rotate(${-this.touch.wheel * 120}deg)`;
      this.stirred = true;
    };
    wheel.addEventListener('pointerdown', event => {
      wheel.setPointerCapture(event.pointerId);
      turn(event);
    });
    wheel.addEventListener('pointermove', event => {
      if (wheel.hasPointerCapture(event.pointerId)) turn(event);
    });
    const release = () => {
      this.touch.wheel = null;
      wheel.firstElementChild.style.transform = '';
    };
    wheel.addEventListener('pointerup', release);
    wheel.addEventListener('pointercancel', release);
    for (const [name, button] of [['gas', gas], ['brake', brake]]) {
      const set = on => {
        this.touch[name] = on;
        button.classList.toggle('down', on);
        this.stirred ||= on;
      };
      button.addEventListener('pointerdown', event => {
        button.setPointerCapture(event.pointerId);
        set(true);
      });
      button.addEventListener('pointerup', () => set(false));
      button.addEventListener('pointercancel', () => set(false));
      button.addEventListener('contextmenu', event => event.preventDefault());
    }
  }

  gamepad() {
    const pad = navigator.getGamepads?.().find(pad => pad?.connected && pad.mapping === 'standard');
    if (!pad) return null;
    const axis = pad.axes[0] ?? 0;
    const wheel = Math.abs(axis) < DEAD ? 0 : -(axis - Math.sign(axis) * DEAD) / (1 - DEAD);
    const pedal = (pad.buttons[7]?.value ?? 0) - (pad.buttons[6]?.value ?? 0);
    if (wheel || pedal) this.stirred = true;
    return wheel || pedal ? { wheel: wheel ** 3 * 0.6 + wheel * 0.4, pedal } : null;
  }

  /** Where pedal and wheel are `seconds` later. */
  move(seconds) {
    const pad = this.gamepad();
    const keys = name => Number(this.down.has(name));
    const wanted = this.touch.wheel ?? keys('left') - keys('right');
    const rate = (Math.abs(wanted) > Math.abs(this.wheel) ? TURN : BACK) * seconds;
    const faster = this.touch.wheel === null ? rate : 8 * seconds;
    this.wheel += Math.max(-faster, Math.min(faster, wanted - this.wheel));
    const gas = Math.max(keys('gas'), Number(this.touch.gas));
    const brake = Math.max(keys('brake'), Number(this.touch.brake));
    const pedal = brake ? -brake : gas;
    const press = PRESS * seconds;
    this.pedal = pedal === 0 ? 0 : this.pedal + Math.max(-press, Math.min(press, pedal - this.pedal));
    if (pad) [this.wheel, this.pedal] = [pad.wheel, pad.pedal];
    return { wheel: this.wheel, pedal: this.pedal };
  }

  /**
   * The gear of a car with this speed, negative backwards: true for reverse. The brake pressed anew
   * in a car that stands puts it into reverse, so that holding the brake at a light does not; gas
   * puts it back once the car has stopped.
   */
  shift(speed) {
    const brakes = this.pedal < 0;
    if (Math.abs(speed) < STANDS && brakes && !this.braked) this.reverse = true;
    else if (speed > STANDS || (speed > -STANDS && this.pedal > 0)) this.reverse = false;
    this.braked = brakes;
    return this.reverse;
  }

  /** The gear of a car that somebody else has driven until now. */
  takeOver(speed) {
    this.reverse = speed < -STANDS;
    this.braked = true;
  }

  /** What the left pedal does next: it brakes a car that drives forwards. */
  backs(speed) {
    return this.reverse || Math.abs(speed) < STANDS;
  }

  /** Whether anything was touched since it was last asked. */
  hasStirred() {
    const { stirred } = this;
    this.stirred = false;
    return stirred;
  }
}
