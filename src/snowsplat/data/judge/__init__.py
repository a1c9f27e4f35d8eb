"""Are the cameras of a dataset possible? `verdict.judge` is the door, the rest its witnesses."""
