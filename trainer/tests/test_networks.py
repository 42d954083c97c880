"""The networks' shapes, and their written-out gradients against autograd."""

import torch
from caraware.learn.fast_mlp import FastMlp
from caraware.learn.networks import Activation, GaussianPolicy, Mlp, entropy, log_probability, policy_mlp, value_mlp
from caraware.learn.objective import clipped_surrogate
from torch import Tensor, nn
from torch.distributions import Independent, Normal

RELU = Activation.RELU


def drawn(network: Mlp, seed: int) -> FastMlp:
    network.initialise(torch.Generator().manual_seed(seed))
    return FastMlp(network)


def modules(mlp: FastMlp) -> nn.Sequential:
    """The same network of torch's own modules."""
    of = {"relu": nn.ReLU, "tanh": nn.Tanh, "linear": nn.Identity}
    result = nn.Sequential()
    for i, layer in enumerate(mlp.layers):
        linear = nn.Linear(layer.inputs, layer.outputs)
        linear.weight.data.copy_(mlp.parameters.value[f"layer{i}.weight"])
        linear.bias.data.copy_(mlp.parameters.value[f"layer{i}.bias"])
        result.extend([linear, of[layer.activation.value]()])
    return result


def gradients_agree(mlp: FastMlp, x: Tensor) -> None:
    for i in range(len(mlp.layers)):
        mlp.parameters.value[f"layer{i}.bias"].uniform_(-0.1, 0.1)
    reference = modules(mlp)
    expected = reference(x)
    upstream = torch.randn(expected.shape)
    expected.backward(upstream)
    torch.testing.assert_close(mlp.forward(x), expected.detach())
    mlp.backward(x, upstream)
    for i, linear in enumerate(m for m in reference if isinstance(m, nn.Linear)):
        torch.testing.assert_close(mlp.parameters.grad[f"layer{i}.weight"], linear.weight.grad, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(mlp.parameters.grad[f"layer{i}.bias"], linear.bias.grad, rtol=1e-4, atol=1e-5)


def test_the_written_out_gradients_are_autograd_s() -> None:
    torch.manual_seed(0)
    torch.set_float32_matmul_precision("highest")
    for mlp in (drawn(policy_mlp(9, 2, (50, 30), RELU), 1), drawn(value_mlp(9, (50, 30, 20), RELU), 2)):
        gradients_agree(mlp, torch.randn(64, 9))
        gradients_agree(mlp, torch.randn(10, 9))


def test_tanh_layers_where_the_configuration_says_so() -> None:
    torch.set_float32_matmul_precision("highest")
    policy = drawn(policy_mlp(9, 2, (50, 30), Activation.TANH), 1)
    value = drawn(value_mlp(9, (50, 30), Activation.TANH), 2)
    assert [layer.activation.value for layer in policy.layers] == ["tanh", "tanh", "tanh"]
    assert [layer.activation.value for layer in value.layers] == ["tanh", "tanh", "linear"]
    for network in (policy, value):
        gradients_agree(network, torch.randn(64, 9))


def test_inference_in_blocks_is_inference_in_one() -> None:
    torch.set_float32_matmul_precision("highest")
    value = drawn(value_mlp(9, (50, 30), RELU), 2)
    x = torch.randn(3000, 9)
    expected = modules(value)(x).detach()
    torch.testing.assert_close(value.infer(x), expected)
    torch.testing.assert_close(value.infer(*x.split([1, 500, 0, 2000, 499])), expected)


def test_no_rows_give_no_outputs_also_at_first() -> None:
    policy = drawn(policy_mlp(11, 2, (8, 4), RELU), 1)
    empty = torch.empty(0, 11)
    assert policy.infer(empty).shape == (0, 2)
    assert policy.infer(empty, empty).shape == (0, 2)
    assert policy.infer().shape == (0, 2)
    assert policy.infer(torch.ones(3, 11)).shape == (3, 2)


def test_the_paper_s_shape_and_a_start_in_the_middle_of_the_map() -> None:
    network = drawn(policy_mlp(9, 2, (500, 300), RELU), 0)
    policy = GaussianPolicy(nn.Identity(), 2, 0.7)
    assert [(layer.inputs, layer.outputs, layer.activation.value) for layer in network.layers] == [
        (9, 500, "relu"),
        (500, 300, "tanh"),
        (300, 2, "tanh"),
    ]
    torch.testing.assert_close(policy.log_std.exp(), torch.tensor([0.7, 0.7]))
    mean = network.infer(torch.rand(2000, 9) * 2 - 1)
    assert mean.shape == (2000, 2)
    assert mean.abs().mean() < 0.4


def test_log_probability_and_entropy_are_those_of_independent_normals() -> None:
    mean, action, log_std = torch.randn(20, 2), torch.randn(20, 2) * 3, torch.tensor([-0.3, 0.4])
    normal = Independent(Normal(mean, log_std.exp()), 1)
    torch.testing.assert_close(log_probability(action, mean, log_std), normal.log_prob(action))
    torch.testing.assert_close(entropy(log_std), normal.entropy()[0])


def test_equation_7_clipped_surrogate_and_its_gradient() -> None:
    torch.manual_seed(1)
    mean = torch.randn(500, 2, dtype=torch.float64, requires_grad=True)
    log_std = torch.tensor([-0.2, 0.1], dtype=torch.float64, requires_grad=True)
    action, advantage = torch.randn(500, 2).double(), torch.randn(500).double()
    old = log_probability(action, mean, log_std).detach() + 0.4 * torch.randn(500)
    ratio = (log_probability(action, mean, log_std) - old).exp()
    loss = -torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    loss.backward()
    with torch.no_grad():
        found = clipped_surrogate(mean, log_std, action, old, advantage, 0.2)
    torch.testing.assert_close(found.loss, loss.detach())
    torch.testing.assert_close(found.mean_gradient, mean.grad)
    torch.testing.assert_close(found.log_std_gradient, log_std.grad)
    assert 0.3 < found.clip_fraction() < 0.9
    assert found.approximate_kl() > 0
