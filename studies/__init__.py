"""Many runs: sampled, executed, stored once, summarised, held against published figures."""
