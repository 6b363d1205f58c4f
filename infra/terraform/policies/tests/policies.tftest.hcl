variables {
  bucket            = "my-cities"
  prefix            = "lund/2026"
  oidc_provider_arn = "arn:aws:iam::123456789012:oidc-provider/oidc.eks.eu-north-1.amazonaws.com/id/ABC"
  namespace         = "plat"
}

run "workers_touch_neither_state_nor_lease" {
  command = apply
  assert {
    condition = alltrue([
      for statement in jsondecode(output.roles.worker.access).Statement : alltrue([
        for resource in statement.Resource : !strcontains(resource, "/state") && !endswith(resource, "lund/2026/*")
      ])
    ])
    error_message = "a worker reaches the jobs' state"
  }
  assert {
    condition = alltrue([
      for statement in jsondecode(output.roles.worker.access).Statement :
      statement.Action == ["s3:GetObject"] || alltrue([for resource in statement.Resource : !endswith(resource, "names/*") && !strcontains(resource, "leader")])
    ])
    error_message = "a worker writes the lease"
  }
  assert {
    condition     = !strcontains(output.roles.worker.access, "Delete") && !strcontains(output.roles.client.access, "Delete")
    error_message = "only coordinators delete"
  }
}

run "nobody_leaves_the_prefix" {
  command = apply
  assert {
    condition = alltrue(flatten([
      for role in values(output.roles) : [
        for statement in jsondecode(role.access).Statement : [
          for resource in statement.Resource :
          startswith(resource, "arn:aws:s3:::my-cities/lund/2026/") || try(statement.Condition.StringLike["s3:prefix"] == ["lund/2026/*"], false)
        ]
      ]
    ]))
    error_message = "a role reaches beyond s3://my-cities/lund/2026"
  }
}

run "a_role_is_for_its_service_account_alone" {
  command = apply
  assert {
    condition = alltrue([
      for name, role in output.roles : jsondecode(role.trust).Statement[0].Condition.StringEquals == {
        "oidc.eks.eu-north-1.amazonaws.com/id/ABC:aud" = "sts.amazonaws.com"
        "oidc.eks.eu-north-1.amazonaws.com/id/ABC:sub" = "system:serviceaccount:plat:${name}"
      }
    ])
    error_message = "another service account can assume a role"
  }
  assert {
    condition     = toset(keys(output.roles)) == toset(["client", "coordinator", "worker"])
    error_message = "roles are coordinator, worker and client"
  }
}

run "plain_http_is_refused" {
  command = apply
  assert {
    condition     = jsondecode(output.bucket).Statement[0].Effect == "Deny" && jsondecode(output.bucket).Statement[0].Condition.Bool["aws:SecureTransport"] == "false"
    error_message = "the bucket accepts requests without TLS"
  }
}

run "a_prefix_that_plat_would_refuse" {
  command = plan
  variables {
    prefix = "/lund"
  }
  expect_failures = [var.prefix]
}
