"""Entry points of the console commands. This module imports no other one of the package."""

from __future__ import annotations

from typing import Final

from egovcp.entry_point import EntryPoint

train: Final = EntryPoint("egovcp-train", "egovcp_train.train")
push: Final = EntryPoint("egovcp-push", "egovcp_train.push")
export: Final = EntryPoint("egovcp-export", "egovcp_train.export")
eval_model: Final = EntryPoint("egovcp-eval-model", "egovcp_train.heldout.command")
train_lowlevel: Final = EntryPoint("egovcp-train-lowlevel", "egovcp_train.lowlevel.train")
eval_lowlevel: Final = EntryPoint("egovcp-eval-lowlevel", "egovcp_train.lowlevel.evaluate")
train_ppo: Final = EntryPoint("egovcp-train-ppo", "egovcp_train.ppo.train")
tune_gait: Final = EntryPoint("egovcp-tune-gait", "egovcp_train.lowlevel.tune")
