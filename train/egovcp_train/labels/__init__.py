"""Labels that a recording gives itself: its end says what its beginning was about to see."""
