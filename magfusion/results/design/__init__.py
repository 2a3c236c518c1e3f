"""Where to put beacons, and where to hold the sensor: choices by the bound that coverage draws."""
