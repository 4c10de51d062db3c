"""The model: track, bicycle, LiDAR, faults, controller, closed loop, Gymnasium environment."""
