"""From innovations to a judgement: how noisy is it, what would explain it, is that plausible, what is announced."""
