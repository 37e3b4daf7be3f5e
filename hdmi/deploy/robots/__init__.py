"""Robots that the runner knows, a module each: `hdmi.deploy.robot.Robot` says what they have. Imports nothing."""
