"""Looking at a run while it goes on and when it is over: in a browser (viser), or as a recording for Rerun."""
