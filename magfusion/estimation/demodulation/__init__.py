"""From samples of the sensor to the phasors of each beacon in each epoch."""
