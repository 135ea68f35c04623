"""Score effects at their null: what each would explain, how surely, and which look alike."""
