// The steps of a calibration, with what was seen so far.
export class Wizard {
  constructor(parent, command) {
    this.parent = parent;
    this.command = command;
  }

  show(state) {
    this.parent.hidden = true;
  }
}
