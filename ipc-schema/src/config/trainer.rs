//! The learner.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use super::text::serde_as_text;

/// The learner that comes with caraware.
pub const OWN_TRAINER: &str = "caraware.train";

/// The learner: PPO with the paper's hyper-parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainerConfig {
    /// Python module that is run as the trainer.
    pub module: String,
    /// Learning rate of Adam at the start.
    pub learning_rate: f64,
    /// Factor on the learning rate after each update.
    pub learning_rate_decay: f64,
    /// Learning rate at the end of training; `None`: `learning_rate_decay` alone.
    pub learning_rate_final: Option<f64>,
    /// Discount γ.
    pub discount: f64,
    /// GAE λ.
    pub gae_lambda: f64,
    /// Clip ε of the probability ratio.
    pub clip_epsilon: f64,
    /// ε at the end of training; `None`: constant.
    pub clip_epsilon_final: Option<f64>,
    /// Standard deviation of the policy at the start, in the action's −1 … 1.
    pub initial_std: f64,
    /// Weight of the entropy bonus.
    pub entropy_scale: f64,
    /// Weight of the entropy bonus at the end of training; `None`: constant.
    pub entropy_scale_final: Option<f64>,
    /// Weight of the value loss.
    pub value_scale: f64,
    /// Largest change of a value in one update; `None`: no limit.
    pub value_clip: Option<f64>,
    /// KL divergence at which an update of the policy ends; `None`: after all epochs.
    pub target_kl: Option<f64>,
    /// First updates in which the policy keeps its parameters.
    #[serde(default)]
    pub value_updates: u64,
    /// Largest norm of the gradient.
    pub max_grad_norm: f64,
    /// Actions tried on every observation.
    pub actions_per_observation: u64,
    /// Samples per update.
    pub horizon: u64,
    /// Samples per gradient step.
    pub batch_size: u64,
    /// Passes over a horizon.
    pub epochs: u64,
    /// Networks of policy and value.
    pub network: Network,
    /// Width of the hidden layers of policy and value network.
    pub hidden: Vec<u64>,
    /// Activation of the hidden layers.
    pub activation: Activation,
    /// Ticks that a gradient reaches back in a network with memory.
    pub truncation_ticks: u64,
    /// Images in a stack that a network sees.
    pub frames: u64,
    /// Train a network of the policy's size by regression beside it.
    pub supervised: bool,
    /// The trainer reads the channel `world` beside its observations.
    pub road_users: bool,
    /// Reward by name.
    pub reward: Reward,
    /// Scale of `bounded_inverse` and `exponential`, metres.
    pub reward_scale_m: f64,
    /// Trainers that learn together by `torch.distributed`, each with a run of its own.
    pub ranks: u32,
    /// Threads of torch; 0 = one for each core.
    pub threads: u64,
    /// Device of the trainer.
    pub device: TrainerDevice,
    /// Precision of the inputs of matrix products.
    pub matmul_precision: MatmulPrecision,
    /// Updates between two checkpoints.
    pub checkpoint_interval: u64,
    /// Newest checkpoints that are kept.
    pub checkpoints_kept: u64,
    /// Updates between two checkpoints that are kept for good; 0 = none.
    pub checkpoint_keep_every: u64,
    /// When the Kalman filter's estimates travel beside the predictions.
    pub estimates: Estimates,
    /// Draw the plots of a run at its end.
    pub plots: bool,
}

/// Reward of a prediction, a function of its Euclidean distance d from the truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reward {
    /// 1 / d.
    Inverse,
    /// 1 / (1 + d / scale).
    BoundedInverse,
    /// exp(−d / scale).
    Exponential,
}

/// Device that the trainer computes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrainerDevice {
    /// The processor.
    Cpu,
    /// A GPU if there is one.
    Auto,
}

/// Precision of the inputs of matrix products.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MatmulPrecision {
    /// Single precision.
    Float32,
    /// bfloat16.
    Bfloat16,
    /// bfloat16 where the processor has AMX.
    Auto,
}

/// Networks of policy and value. Configurations and run files write "mlp", "gru", or the class.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Network {
    /// Hidden layers alone, without memory.
    Mlp,
    /// The last hidden layer is a gated recurrent unit, with a state for each slot.
    Gru,
    /// Convolutions over a stack of images, then the hidden layers.
    Cnn,
    /// A class of the user's.
    Class(PythonClass),
}

/// A Python class, written as "package.module:Class".
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PythonClass {
    /// The module, with its packages.
    pub module: String,
    /// The class in it.
    pub class: String,
}

/// The text is not a network.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is neither a network by name nor a Python class")]
pub struct TrainerNetworkError(pub String);

serde_as_text!(Network);

impl Activation {
    /// Its name in `trainer.activation`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Relu => "relu",
            Self::Tanh => "tanh",
        }
    }
}

impl FromStr for Network {
    type Err = TrainerNetworkError;

    fn from_str(text: &str) -> Result<Self, TrainerNetworkError> {
        match text {
            "mlp" => Ok(Self::Mlp),
            "gru" => Ok(Self::Gru),
            "cnn" => Ok(Self::Cnn),
            _ => PythonClass::parse(text)
                .map(Self::Class)
                .ok_or_else(|| TrainerNetworkError(text.to_owned())),
        }
    }
}

impl fmt::Display for Network {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mlp => formatter.write_str("mlp"),
            Self::Gru => formatter.write_str("gru"),
            Self::Cnn => formatter.write_str("cnn"),
            Self::Class(PythonClass { module, class }) => write!(formatter, "{module}:{class}"),
        }
    }
}

impl PythonClass {
    fn parse(text: &str) -> Option<Self> {
        let is_name = |name: &str| {
            name.chars().all(|c| c.is_alphanumeric() || c == '_') && name.starts_with(|c: char| !c.is_numeric())
        };
        let (module, class) = text.split_once(':')?;
        (module.split('.').all(is_name) && is_name(class)).then(|| Self {
            module: module.to_owned(),
            class: class.to_owned(),
        })
    }
}

/// Activation of the hidden layers of policy and value network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// max(0, x).
    Relu,
    /// tanh x.
    Tanh,
}

/// Times at which the trainer runs the Kalman filter beside the policy, for viewers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Estimates {
    /// In a run paced by the wall clock: at full speed the filter costs more than the policy.
    Paced,
    /// Always.
    Always,
    /// Never.
    Never,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_network_has_a_name_or_is_a_python_class() {
        let class: Network = serde_json::from_str("\"my_package.nets:Deep2\"").unwrap();
        assert_eq!(
            class,
            Network::Class(PythonClass {
                module: "my_package.nets".into(),
                class: "Deep2".into()
            })
        );
        for text in ["mlp", "gru", "cnn", "my_package.nets:Deep2"] {
            assert_eq!(text.parse::<Network>().unwrap().to_string(), text);
        }
        for text in ["", "mlpp", "nets.Deep", "nets:", ":Deep", "nets:2Deep", "a..b:C"] {
            assert_eq!(text.parse::<Network>(), Err(TrainerNetworkError(text.to_owned())));
        }
    }
}
