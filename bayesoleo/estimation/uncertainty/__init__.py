"""How sure an estimate is: intervals, regions, profiles and repeated experiments."""
