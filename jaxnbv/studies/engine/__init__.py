"""What a study is, how its scenes are run, and how its results are shown."""
