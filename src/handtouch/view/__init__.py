"""What a person sees of a running hand: lines for pipes and logs, a live page in the terminal."""
