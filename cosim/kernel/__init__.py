"""What runs the filter over a log: arrays in, arrays out, whatever it is made of."""
