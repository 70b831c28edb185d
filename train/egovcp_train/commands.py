"""Entry points of the console commands. Nothing else is imported here: see `EntryPoint`."""

from egovcp.entry_point import EntryPoint

train = EntryPoint("egovcp-train", "egovcp_train.train")
push = EntryPoint("egovcp-push", "egovcp_train.publish")
export = EntryPoint("egovcp-export", "egovcp_train.export")
eval_model = EntryPoint("egovcp-eval-model", "egovcp_train.heldout.command")
train_lowlevel = EntryPoint("egovcp-train-lowlevel", "egovcp_train.lowlevel.train")
eval_lowlevel = EntryPoint("egovcp-eval-lowlevel", "egovcp_train.lowlevel.evaluate")
train_ppo = EntryPoint("egovcp-train-ppo", "egovcp_train.ppo.train")
