"""Light transport: camera rays, shadows, bounces, further outputs, and the choice of a method."""
