# Who may do what in the bucket, as plain values: this module needs no provider, so that what it says can be tested anywhere.
#
#                 artefacts/   names/leader/   names/results/, names/checkpoints/   names/ingest/   state/
#   coordinator   all          all             all                                  all             all       (plat forget deletes)
#   worker        read, add    read            read, write                          read            -
#   client        read, add    read            -                                    read, write     -
#
# So a worker that was broken into can waste work, which the hashes of artefacts show; it can touch neither the jobs' state nor the
# lease that says who leads.

locals {
  partition = split(":", var.oidc_provider_arn)[1]
  issuer    = split(":oidc-provider/", var.oidc_provider_arn)[1]
  arn       = "arn:${local.partition}:s3:::${var.bucket}"

  # By role: folders that it reads, writes and empties.
  access = {
    coordinator = { reads = ["*"], writes = ["*"], deletes = ["*"] }
    worker = {
      reads   = ["artefacts/*", "names/*"]
      writes  = ["artefacts/*", "names/results/*", "names/checkpoints/*"]
      deletes = []
    }
    client = {
      reads   = ["artefacts/*", "names/*"]
      writes  = ["artefacts/*", "names/ingest/*"]
      deletes = []
    }
  }

  statements = {
    for role, may in local.access : role => concat(
      [
        for action, folders in { GetObject = may.reads, PutObject = may.writes, DeleteObject = may.deletes } : {
          Effect                           = "Allow"
          Action                           = ["s3:${action}"]
          Resource                         = [for folder in folders : "${local.arn}/${var.prefix}/${folder}"]
        } if length(folders) > 0
      ],
      # Without this an object that is not there looks like one that may not be read.
      [{
        Effect    = "Allow"
        Action    = ["s3:ListBucket"]
        Resource  = [local.arn]
        Condition = { StringLike = { "s3:prefix" = ["${var.prefix}/*"] } }
      }],
    )
  }
}

output "bucket" {
  description = "The bucket's policy (JSON): nothing without encryption on the way."
  value = jsonencode({
    Version = "2012-10-17"
    Statement = [{
      Sid       = "EncryptedOnTheWay"
      Effect    = "Deny"
      Principal = "*"
      Action    = ["s3:*"]
      Resource  = [local.arn, "${local.arn}/*"]
      Condition = { Bool = { "aws:SecureTransport" = "false" } }
    }]
  })
}

output "roles" {
  description = "By role: who may take it (trust) and what it may do (access), both JSON."
  value = {
    for role, statements in local.statements : role => {
      access = jsonencode({ Version = "2012-10-17", Statement = statements })
      trust = jsonencode({
        Version = "2012-10-17"
        Statement = [{
          Effect    = "Allow"
          Action    = "sts:AssumeRoleWithWebIdentity"
          Principal = { Federated = var.oidc_provider_arn }
          Condition = {
            StringEquals = {
              "${local.issuer}:aud" = "sts.amazonaws.com"
              "${local.issuer}:sub" = "system:serviceaccount:${var.namespace}:${role}"
            }
          }
        }]
      })
    }
  }
}
