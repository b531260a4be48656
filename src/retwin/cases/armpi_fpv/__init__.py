"""The ArmPi FPV robot arm: MuJoCo and closed-form twins, emulator, command recovery."""
